"""The wheel holds the grammar, the models and the catalogue, and nothing that is not the package's."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def members(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT)]
    made = subprocess.run(command, capture_output=True, text=True)
    if made.returncode and "hatchling" in made.stderr:
        pytest.skip("the build backend cannot be installed here")
    assert made.returncode == 0, made.stderr
    (wheel,) = folder.glob("gbspec-*.whl")
    return set(zipfile.ZipFile(wheel).namelist())


def test_every_file_of_the_package_is_there(members: set[str]) -> None:
    kinds = {".py", ".toml", ".typed", ".j2", ".js", ".txt"}
    wanted = {str(path.relative_to(ROOT)) for path in (ROOT / "gbspec").rglob("*") if path.suffix in kinds}
    assert {name for name in wanted if "__pycache__" not in name} | {"gbspec/py.typed"} <= members


@pytest.mark.parametrize(("folder", "inside"), [("grammar", "gbspec/_grammar"), ("models", "gbspec/_models")])
def test_the_grammar_and_the_models_are_inside(members: set[str], folder: str, inside: str) -> None:
    # The editor's extension is a package of its own
    files = (ROOT / folder).glob("*") if folder == "grammar" else (ROOT / folder).rglob("*")
    wanted = {f"{inside}/{p.relative_to(ROOT / folder)}" for p in files if p.is_file()}
    assert wanted <= members
    assert not any("vscode" in name for name in members)
    assert wanted


def test_nothing_else_is_in_it(members: set[str]) -> None:
    assert all(name.startswith(("gbspec/", "gbspec-")) for name in members)
    assert not any(".pyc" in name or "/tests/" in name for name in members)
