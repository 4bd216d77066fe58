"""The documentation site: pages whose code is right as far as can be seen without running it, and tools that build it.

`make docs` builds the site with warnings as errors, `make docs-run` runs every block of the tutorial and the how-to
pages; both take minutes and belong to the workflow of the documentation.
"""

from __future__ import annotations

import ast
import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from benchmarks.gallery.__main__ import LARGEST
from benchmarks.gallery.page import cases, page
from gbspec import frontend
from gbspec.cli.app import COMMANDS
from gbspec.diagnostics import Findings, Severity
from gbspec.diagnostics.catalogue import all_codes
from tests.cli.command_lines import accepted

DOCS = Path(__file__).parents[2] / "docs"


def tool(name: str) -> ModuleType:
    """A module of docs/site, which is no package."""
    spec = importlib.util.spec_from_file_location(f"site_{name}", DOCS / "site" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    made = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


BLOCKS = tool("blocks")
PAGES = [*BLOCKS.pages(), DOCS / "gallery.md", DOCS / "index.md", DOCS / "data_sources.md"]
GALLERY = DOCS / "gallery" / "measured.json"


def lines(path: Path) -> list[str]:
    """The gbspec commands of a page's shell blocks."""
    shells = [block.text for block in BLOCKS.blocks(path.read_text("utf-8")) if block.language == "sh"]
    return [line for text in shells for line in text.splitlines() if line.startswith("gbspec ")]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_command_of_a_page_is_accepted(path: Path) -> None:
    plain = [re.sub(r"\$\(.*\)| [<>] [\w.]+$", "", line) for line in lines(path)]
    assert [line for line in plain if not accepted(line)] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_model_of_a_page_compiles_and_every_python_block_is_python(path: Path, tmp_path: Path) -> None:
    for number, block in enumerate(BLOCKS.blocks(path.read_text("utf-8"))):
        if block.language == "python":
            ast.parse(block.text)
        if block.language == "gb":
            file = tmp_path / (block.file or f"block{number}.gb")
            file.write_text(block.text, encoding="utf-8")
            findings = Findings()
            frontend.load_model(file, findings)
            assert [found.message for found in findings if found.severity is Severity.ERROR] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_every_link_of_a_page_has_a_target(path: Path) -> None:
    generated = {"commands.md", "diagnostics.md", "python.md"}  # in docs/reference, made when the site is built
    prose = re.sub(r"^ *```.*?^ *```$", "", path.read_text("utf-8"), flags=re.S | re.M)
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", prose):
        found = path.parent / target
        assert found.exists() or (found.parent.name == "reference" and found.name in generated), target


def test_every_page_is_in_the_contents() -> None:
    found = set(re.findall(r"^[\w/*-]+$", (DOCS / "index.md").read_text("utf-8"), re.M))
    assert {path.stem for path in DOCS.glob("*.md")} - {"index"} <= found
    inside = set(re.findall(r"^[\w-]+$", (DOCS / "howto" / "index.md").read_text("utf-8"), re.M))
    assert {path.stem for path in (DOCS / "howto").glob("*.md")} - {"index"} <= inside


def test_blocks_are_run_as_a_reader_meets_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "```gb file=m.gb\nmodel m\n```\n1. x\n\n   ```sh\n   cp m.gb n.gb\n   ```\n\n"
    text += "<!-- not run: why -->\n```sh\nfalse\n```\n"
    (tmp_path / "page.md").write_text(text + "```python\nfrom pathlib import Path\nPath('k').touch()\n```\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    BLOCKS.run_page(tmp_path / "page.md")
    assert (tmp_path / "n.gb").read_text() == "model m\n" and (tmp_path / "k").exists()
    (tmp_path / "page.md").write_text("```sh\nfalse\n```\n")
    with pytest.raises(SystemExit, match="status 1"):
        BLOCKS.run_page(tmp_path / "page.md")


def test_what_a_page_loads_from_the_network_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    offline = tool("offline")
    (tmp_path / "good.html").write_text('<a href="https://x.org">x</a><img src="_images/a.png"><p>url(https://y)</p>')
    (tmp_path / "good.css").write_text("a { background: url(data:image/png;base64,AA) }")
    assert offline.main(str(tmp_path)) == 0
    for number, text in enumerate(
        [
            '<script src="https://cdn/a.js"></script>',
            '<link rel="stylesheet" href="//cdn/a.css">',
            '<img src="http://a/b">',
        ],
    ):
        (tmp_path / f"bad{number}.html").write_text(text)
    (tmp_path / "bad.css").write_text('@import "https://fonts/a.css"; b { src: url(https://fonts/b.woff2) }')
    assert offline.main(str(tmp_path)) == 1
    assert capsys.readouterr().out.count(": loads ") == 5


def test_the_generated_pages_have_every_command_and_code(monkeypatch: pytest.MonkeyPatch) -> None:
    made = tool("reference").pages()
    assert [name for name in COMMANDS if f"\n## gbspec {name}\n" not in made["commands.md"]] == []
    assert [code for code in all_codes() if f"\n### {code}\n" not in made["diagnostics.md"]] == []
    assert (
        "`--effort` `low" in made["commands.md"].replace("\\|", "|")
        and "autoclass:: gbspec.fitted.FittedRun" in made["python.md"]
    )


def test_links_out_of_the_pages_lead_to_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    hooks = tool("hooks")
    text = ["see [a](../grammar/vscode) and [b](training.md)"]
    hooks.repository_links(text, "https://host/x/blob/main")
    assert text == ["see [a](https://host/x/blob/main/grammar/vscode) and [b](training.md)"]
    text = ["see [a](../grammar/vscode) and [t](../training.md)"]
    hooks.repository_links(text, "")
    assert text == ["see a and [t](../training.md)"]


def test_the_gallery_is_what_was_measured_and_its_figures_are_small() -> None:
    measured = json.loads(GALLERY.read_text(encoding="utf-8"))
    assert (DOCS / "gallery.md").read_text(encoding="utf-8") == page(measured)
    shown = {name: case for name, case in cases().items() if name in measured}
    assert len(shown) >= 10 and sum(bool(case.table) for case in shown.values()) >= 3
    for case in shown.values():
        assert 0 < (DOCS / "gallery" / case.figure).stat().st_size <= LARGEST, case.figure
