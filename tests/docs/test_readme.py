"""README.md is correct: its model compiles, its command lines are accepted, its links have targets."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from gbspec import frontend
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings, UserError
from gbspec.diagnostics.render import render_text
from tests.cli.command_lines import accepted

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"^gbspec .*$|(?<=`)gbspec [^`]*(?=`)", TEXT, re.M)))


def blocks(language: str) -> Iterator[str]:
    yield from re.findall(rf"^```{language}\n(.*?)^```$", TEXT, re.S | re.M)


def test_the_model_compiles_and_means_what_is_shipped(tmp_path: Path) -> None:
    (text,) = blocks("gb")
    path = tmp_path / "urp_gb2.gb"
    path.write_text(text)
    findings = Findings()
    written, shipped = frontend.load_model(path, findings), frontend.load_model("urp_gb2", Findings())
    assert not list(findings)
    assert written.balances == shipped.balances
    assert written.networks[0].hidden == shipped.networks[0].hidden
    assert written.learnables == tuple(shipped.learnables)


def test_the_message_is_the_one_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (shown,) = re.findall(r"^```\n(error\[.*?)^```$", TEXT, re.S | re.M)
    monkeypatch.chdir(tmp_path)
    Path("reactor.gb").write_text("model urp_gb2\nstate x1\nunknown phi(x1)\n\n\n\n\nx1' = -x1 + phii\nobserve x1\n")
    with pytest.raises(UserError) as caught:
        frontend.load_model("reactor.gb", Findings())
    assert shown.strip() in render_text(caught.value.diagnostics)


@pytest.mark.parametrize("line", [line for line in COMMANDS if " " in line and not line.endswith(("command", "CODE"))])
def test_every_command_line_is_accepted(line: str) -> None:
    assert accepted(line) or (line.split()[1] in ("compile", "check") and len(line.split()) == 2)


def test_every_link_leads_somewhere() -> None:
    prose = re.sub(r"^```.*?^```$", "", TEXT, flags=re.S | re.M)
    for target in re.findall(r"\]\(([^)#]+)\)", prose):
        assert (ROOT / target).exists(), target


def test_every_bundled_model_is_named() -> None:
    assert [name for name in shipped_models() if name not in TEXT] == []
