"""Files for a release agree with pyproject.toml: versions, the conda recipe, the workflows."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

yaml = pytest.importorskip("yaml")
ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}


@pytest.fixture
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("release_versions", ROOT / "packaging" / "versions.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_all_files_name_one_version(tool: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert set(tool.versions().values()) == {PROJECT["version"]}
    assert tool.main([f"v{PROJECT['version']}"]) == 0
    assert tool.main(["v99.0.0"]) == 1
    assert "the tag: 99.0.0" in capsys.readouterr().out


def test_the_changes_of_a_version_are_its_section(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tool, "ROOT", tmp_path)
    (tmp_path / "CHANGELOG.md").write_text("# C\n\n## [2.0.0] - x\n\n- b\n\n## [1.0.0] - y\n\n- a\n")
    assert tool.changes("2.0.0") == "- b\n" and tool.changes("1.0.0") == "- a\n"
    with pytest.raises(SystemExit, match=r"no section of 3\.0\.0"):
        tool.changes("3.0.0")


def test_the_conda_recipe_has_the_requirements() -> None:
    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
    needed = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["train"]]  # conda's packages have no extras
    wanted = {re.sub(r"([<>=])", r" \1", one, count=1) for one in needed}
    wanted = {" ".join([CONDA_NAMES.get(name, name), rest]) for name, rest in (one.split(" ", 1) for one in wanted)}
    assert set(recipe["requirements"]["run"]) == wanted | {f"python {PROJECT['requires-python']}"}
    assert recipe["build"]["python"]["entry_points"] == [f"gbspec = {PROJECT['scripts']['gbspec']}"]
    assert recipe["about"]["license"] == PROJECT["license"]


def test_the_citation_is_complete() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors", "version", "license"} <= set(citation)
    assert str(citation["version"]) == PROJECT["version"] and citation["license"] == PROJECT["license"]


def test_the_workflows_are_readable_and_publish_only_tags() -> None:
    flows = {
        path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))
        for path in (ROOT / ".github" / "workflows").glob("*.yml")
    }
    assert {"ci", "docs", "release"} <= set(flows)
    publish = flows["release"]["jobs"]["publish"]
    assert publish["if"] == "github.ref_type == 'tag'" and publish["permissions"]["id-token"] == "write"
    steps = [step.get("run", "") for step in flows["release"]["jobs"]["test"]["steps"]]
    assert any("gbspec train" in step for step in steps) and any(".whl)[train]" in step for step in steps)
    assert "password" not in str(publish) and "secrets" not in str(flows["release"])


def test_the_extra_for_the_documentation_is_pinned() -> None:
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").lower()
    for requirement in PROJECT["optional-dependencies"]["docs"]:
        assert re.search(rf"^{re.split('[<>=]', requirement)[0]}==", pins, re.M), requirement
