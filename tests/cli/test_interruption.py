"""What is said when training is interrupted: true of the directory as it is then."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.cli.frame import INTERRUPTED, ExitWith
from gbspec.cli.interruption import continued


def said_of(directory: Path, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(ExitWith) as caught, continued(directory):
        raise KeyboardInterrupt
    assert caught.value.status == INTERRUPTED
    return capsys.readouterr().err


def test_what_does_not_exist_is_not_to_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["gbspec", "train", "m.gb", "d.csv", "-o", "run"])
    said = said_of(tmp_path / "run", capsys)
    assert "nothing was written yet" in said and "--resume" not in said
    (tmp_path / "run").mkdir()
    said = said_of(tmp_path / "run", capsys)
    assert "has no weights yet; to continue: gbspec train m.gb d.csv -o run --resume" in said and "0 of 0" not in said
