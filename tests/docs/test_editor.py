"""docs/editor.md agrees with the output of `check --json`."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from gbspec.cli.app import build
from gbspec.diagnostics import Findings, Source
from gbspec.diagnostics.render import to_json
from gbspec.semantics import check
from gbspec.syntax.parser import parse

TEXT = (Path(__file__).parents[2] / "docs" / "editor.md").read_text(encoding="utf-8")


def table(after: str) -> set[str]:
    """The keys in the first column of the table after a sentence."""
    rows = TEXT.split(after, 1)[1].split("\n\n", 2)[1]
    return {key for row in rows.splitlines()[2:] for key in re.findall(r"`(\w+)`", row.split("|")[1])}


def document(tmp_path: Path, text: str) -> dict[str, Any]:
    path = tmp_path / "reactor.gb"
    path.write_text(text)
    made: dict[str, Any] = json.loads(CliRunner().invoke(build(["check"]), ["check", "--json", str(path)]).stdout)
    return made


@pytest.mark.parametrize(
    "text", ["model m\nstate x = 1\nlearn k = 1 in [0, 2]\nx' = -k*x\nobserve x\n", "model m\nstate x\n"]
)
def test_every_key_of_a_file_and_of_a_diagnostic_is_documented(tmp_path: Path, text: str) -> None:
    file = document(tmp_path, text)["files"][0]
    assert set(file) == table("one entry for each file")
    for finding in file["diagnostics"]:
        assert set(finding) == table("A finding:")


def test_the_example_is_what_gbspec_says() -> None:
    lines = [
        "model m",
        "state x = 1",
        "learn beta = 1 in [0, 2]",
        *["# "] * 4,
        "x' = -x         - betta + beta",
        "observe x",
    ]
    findings = Findings()
    file = parse(Source("reactor.gb", "\n".join(lines)), findings)
    assert file is not None
    check(file, findings, lambda path: Source(str(path), ""))
    shown = re.search(r"```json\n(.*?)```", TEXT, re.DOTALL)
    assert shown is not None
    assert [to_json(d) for d in findings] == [json.loads(shown[1])]


def test_the_settings_for_helix_are_toml() -> None:
    shown = re.search(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    assert shown is not None
    settings = tomllib.loads(shown[1])
    assert settings["language-server"]["gbspec"]["args"] == ["lsp"]
    assert settings["language"][0]["language-servers"] == ["gbspec"]


def test_the_links_lead_to_files() -> None:
    folder = Path(__file__).parents[2] / "docs"
    for link in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (folder / link).exists(), link
