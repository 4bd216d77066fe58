"""What works without packages that an installation may lack, and how the others are asked for."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from gbspec.diagnostics.installed import EXTRAS, REQUIRED

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

COMMANDS = """
import contextlib, io, json, sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split(","):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Refuse())
from gbspec.cli import main

found = []
for line in json.loads(sys.argv[2]):
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        try:
            main(line)
            status = 0
        except SystemExit as leave:
            status = leave.code or 0
    found.append([status, told.getvalue()])
print(json.dumps(found))
"""
READING = [
    ["check", "urp_gb2"],
    ["new", "mine"],
    ["fmt", "--check", "mine.gb"],
    ["compile", "urp_gb2", "-o", "urp.py"],
    ["compile", "urp_gb2", "-o", "urp.tex", "--emit", "latex"],
    ["explain", "GB201"],
    ["models"],
]
SOLVING = [
    ["simulate", "urp_gb2", "-o", "data.csv", "--trajectories", "2"],
    ["eigen", "urp_gb2", "--at", "x1=0.4,x2=1.2,Da=0.3"],
    ["compile", "urp_gb2", "-o", "urp.c", "--emit", "c"],
]
TRAINING = [["train", "urp_gb2", "data.csv", "-o", "run"], ["crossvalidate", "urp_gb2", "data.csv", "-o", "cross"]]


def statuses(folder: Path, without: str, commands: list[list[str]]) -> list[tuple[int, str]]:
    """The exit status and the messages of commands, where some packages cannot be imported."""
    program = [sys.executable, "-c", COMMANDS, without, json.dumps(commands)]
    done = subprocess.run(program, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return [(status, told) for status, told in json.loads(done.stdout.splitlines()[-1])]


def test_without_torch_all_but_training_works(tmp_path: Path) -> None:
    found = statuses(tmp_path, "torch,distributed", [*READING, *SOLVING, *TRAINING])
    working = len(READING) + len(SOLVING)
    assert [status for status, _ in found[:working]] == [0] * working, found
    for status, told in found[working:]:
        assert status == 1, told
        assert "error[GB866]" in told
        assert "pip install 'gbspec[train]'" in told
        assert "defect" not in told
    assert not (tmp_path / "run").exists()


def test_without_casadi_models_are_read_and_compiled(tmp_path: Path) -> None:
    found = statuses(tmp_path, "torch,casadi", [*READING, *SOLVING])
    assert [status for status, _ in found[: len(READING)]] == [0] * len(READING), found
    for status, told in found[len(READING) :]:
        assert status == 1, told
        assert "`casadi`" in told
        assert "pip install casadi" in told


def test_the_python_interface_raises_user_errors(tmp_path: Path) -> None:
    program = f"""
import sys
for name in ("torch", "casadi"):
    sys.modules[name] = None
import gbspec
model = gbspec.load("urp_gb2")
for call in (lambda: model.simulate(trajectories=1), lambda: model.train({{"t": [0.0, 1.0], "x1": [0.1, 0.2],
             "x2": [1.0, 1.1], "Da": [0.3, 0.3]}}, {str(tmp_path / "run")!r})):
    try:
        call()
    except gbspec.UserError as error:
        print(error.diagnostics[0].code, error.diagnostics[0].help)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [
        "GB866 install it: `pip install casadi`",
        "GB866 install it: `pip install 'gbspec[train]'`",
    ], done.stderr


def test_the_advice_names_extras_that_exist() -> None:
    extras = PROJECT["optional-dependencies"]
    projects = {"libsbml": "python-libsbml", "yaml": "pyyaml"}  # where a package is called otherwise
    for name, (extra, _) in EXTRAS.items():
        package = projects.get(name, name)
        assert any(requirement.startswith(package) for requirement in extras[extra])
        assert any(requirement.startswith(package) for requirement in extras["all"])
        assert not any(requirement.startswith(package) for requirement in PROJECT["dependencies"])
    for package in REQUIRED:
        assert any(requirement.startswith(package) for requirement in PROJECT["dependencies"])


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_what_goes_into_a_file_is_utf_8(tmp_path: Path, encoding: str) -> None:
    text = 'model a "Größe θ → ∞"\nstate x = 1\nx\' = -x\nobserve x\n'
    done = subprocess.run(
        [sys.executable, "-m", "gbspec", "fmt", "-"],
        input=text.encode(),
        env={**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"},
        capture_output=True,
        check=False,
    )
    assert done.stdout.replace(b"\r\n", b"\n").decode("utf-8") == text
