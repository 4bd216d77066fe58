"""Results show themselves in a notebook, and the one that comes along was executed from its first to its last cell."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import gbspec
from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.report.notebook import png, register
from tests.analysis.textbook import brusselator

NOTEBOOK = Path(__file__).parents[2] / "docs" / "urp.ipynb"


@pytest.fixture(scope="module")
def cells() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in found if cell["cell_type"] == "code"]


def test_every_cell_was_executed_in_order_without_an_error(cells: list[dict[str, Any]]) -> None:
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = [output["output_type"] for cell in cells for output in cell["outputs"]]
    assert kinds
    assert "error" not in kinds


def test_it_shows_the_diagram_of_what_was_learned(cells: list[dict[str, Any]]) -> None:
    (cell,) = (cell for cell in cells if "".join(cell["source"]).startswith('run.bifurcate("Da"'))
    (shown,) = (output["data"] for output in cell["outputs"] if output["output_type"] == "execute_result")
    assert "image/png" in shown
    assert "".join(shown["text/plain"]).count("Hopf point at Da") == 2


def test_its_cells_still_compile_and_name_what_there_is(cells: list[dict[str, Any]]) -> None:
    for cell in cells:
        compile("".join(cell["source"]), "cell", "exec")
    model = gbspec.load("urp_gb1")
    assert "unknown phi" in model.model.text


def test_a_diagram_shows_itself_as_text_and_figure() -> None:
    interactive = pytest.importorskip("IPython.core.interactiveshell", reason="IPython is not installed")
    shell = interactive.InteractiveShell.instance()
    try:
        register()
        diagram = bifurcate(brusselator(), "B", 1.0, 3.0, BifurcationOptions(cycles=False))
        data, _ = shell.display_formatter.format(diagram)
        assert data["text/plain"] == str(diagram)
        assert data["image/png"] == png(diagram)
        assert data["image/png"].startswith(b"\x89PNG")
    finally:
        interactive.InteractiveShell.clear_instance()


def test_what_has_no_figure_is_refused() -> None:
    with pytest.raises(TypeError, match="int has no figure"):
        gbspec.figure(3)
