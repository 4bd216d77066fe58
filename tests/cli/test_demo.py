"""What `gbspec demo` says at its end: commands that can be typed where it ran."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from gbspec.cli.commands.demo import next_commands, typed
from tests.cli.command_lines import accepted


def test_three_commands_follow_that_gbspec_accepts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/gbspec")
    commands = next_commands(Path("demo/urp_gb2_run"))
    assert len(commands) == 3
    assert all(accepted(line) for line in commands)


def test_gbspec_is_called_as_it_was_where_its_name_is_not_on_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.chdir(tmp_path)
    program = tmp_path / ".venv" / "bin" / "gbspec"
    program.parent.mkdir(parents=True)
    program.touch()
    assert typed(str(program)) == typed(".venv/bin/gbspec") == ".venv/bin/gbspec"
    assert typed("/usr/lib/python3/gbspec/__main__.py") == "python -m gbspec"
