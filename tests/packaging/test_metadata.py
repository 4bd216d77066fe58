"""What the packaging files say agrees with each other and with the code."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import gbspec

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PINS = dict(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.M))
NORMAL_PINS = {name.lower().replace("_", "-") for name in PINS}


def names(requirements: list[str]) -> set[str]:
    return {re.split(r"[<>=!~ \[;]", requirement)[0].lower() for requirement in requirements}


def test_the_version_is_said_once_more_and_alike() -> None:
    assert PROJECT["version"] == gbspec.__version__


def test_every_requirement_is_pinned() -> None:
    wanted = names(PROJECT["dependencies"]) | names(PROJECT["optional-dependencies"]["dev"])
    assert wanted <= NORMAL_PINS


def test_every_import_is_a_declared_dependency() -> None:
    imported: set[str] = set()
    for path in (ROOT / "gbspec").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.split(".")[0])
    foreign = {name.replace("_", "-") for name in imported - set(sys.stdlib_module_names) - {"gbspec"}}
    renamed = {"libsbml": "python-libsbml", "yaml": "pyyaml"}  # modules named otherwise than their packages
    foreign = {renamed.get(name, name) for name in foreign}
    extras = (requirement for group in PROJECT["optional-dependencies"].values() for requirement in group)
    declared = names(PROJECT["dependencies"]) | names(list(extras))
    assert foreign <= declared, foreign - declared


def test_the_makefile_finds_the_pinned_torch() -> None:
    made = subprocess.run(["make", "-n", "-B", "environment"], check=True, capture_output=True, text=True, cwd=ROOT)
    assert f"torch=={PINS['torch']}" in made.stdout
    assert made.stdout.index("torch==") < made.stdout.index(".[dev]")


def test_import_is_light() -> None:
    code = (
        "import sys, gbspec; print(sorted({'torch', 'casadi', 'sympy', 'numpy', 'lark', 'typer'} & set(sys.modules)))"
    )
    shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert shown.stdout.strip() == "[]"


def test_the_package_has_no_other_attributes() -> None:
    with pytest.raises(AttributeError, match="no attribute `absent`"):
        _ = gbspec.absent
    assert set(gbspec.__all__) == set(dir(gbspec))
    assert all(getattr(gbspec, name) is not None for name in gbspec.__all__)
