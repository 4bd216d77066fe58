"""A run of an older module interface: commands name the version that wrote it, beside their results."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from gbspec.backends.module import INTERFACE
from gbspec.cli.app import build
from gbspec.diagnostics import Findings, Severity
from gbspec.runs import open_run
from tests.runs.test_record import VERSION_0_1_0

pytestmark = pytest.mark.usefixtures("few_points")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of a run directory that gbspec 0.1.0 wrote, beside its data."""
    shutil.copy(VERSION_0_1_0 / "data.csv", tmp_path / "data.csv")
    shutil.copytree(VERSION_0_1_0 / "run", tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    return tmp_path / "run"


def set_interface(run: Path, interface: int) -> None:
    fit = json.loads((run / "fit.json").read_text())
    (run / "fit.json").write_text(json.dumps(fit | {"interface": interface}))


def test_opening_warns_of_an_older_interface_alone(run: Path) -> None:
    findings = Findings()
    open_run(run, findings)
    (found,) = findings
    assert (found.code, found.severity) == ("GB857", Severity.WARNING)
    assert "was written by gbspec 0.1.0 for the module interface 1" in found.message
    assert f"for the interface {INTERFACE}" in found.message and "--resume" in found.help
    set_interface(run, INTERFACE)
    findings = Findings()
    open_run(run, findings)
    assert not findings


@pytest.mark.parametrize(
    "command", ["validate run data.csv", "predict run data.csv -o p.csv", "eigen run", "compile run -o m.py"]
)
def test_a_command_warns_on_standard_error_and_its_json_is_the_same(run: Path, command: str) -> None:
    name, *rest = command.split()
    older = CliRunner().invoke(build([name]), [name, *rest, "--json"])
    assert older.exit_code == 0 and "warning[GB857]" in older.stderr
    quiet = CliRunner().invoke(build([name]), [name, *rest, "--json", "--quiet"])
    set_interface(run, INTERFACE)
    newer = CliRunner().invoke(build([name]), [name, *rest, "--json"])
    assert "GB857" not in newer.stderr and "GB857" not in quiet.stderr
    assert json.loads(older.stdout) == json.loads(newer.stdout) == json.loads(quiet.stdout)
