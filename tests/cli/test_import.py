"""import: the command, its document, and its refusals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from tests.imports import models as made

pytest.importorskip("libsbml", reason="SBML needs the extra `sbml`")

Run = Callable[..., Any]
GROWTH = made.sbml(made.parameters("false", x="1"), made.rules(x=made.apply("times", "2", "x")))


def test_a_model_is_imported_and_simulated_at_the_times_of_the_source(here: Path, gbspec: Run, document: Run) -> None:
    made.stored(here, GROWTH, "growth.xml")
    found = document("import", "growth.xml", "-o", "out")
    assert found == {"model": str(Path("out/made.gb")), "data": None, "options": {}, "left_out": []}
    assert (here / "out" / "left_out.csv").read_text() == "element,line,reason\n"
    result = gbspec("simulate", "out/made.gb", "-o", "o.csv", "--trajectories", 1, "--span", 1, "--dt", 0.5,
                    "--sampling", "regular", "--keep-start")  # fmt: skip
    assert result.exit_code == 0, result.stderr
    assert pl.read_csv("o.csv")["x"].to_list() == pytest.approx([1, 2.718281828, 7.389056099], rel=1e-8)
    assert gbspec("import", "growth.xml", "-o", "out").exit_code == 0, "an import replaces an import"


def test_a_model_of_the_user_is_not_replaced(here: Path, gbspec: Run) -> None:
    made.stored(here, GROWTH, "growth.xml")
    (here / "made.gb").write_text("model made\n")
    result = gbspec("import", "growth.xml", "-o", ".")
    assert result.exit_code == 1
    assert "GB897" in result.stderr
    assert (here / "made.gb").read_text() == "model made\n"


@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("m.xml", "<html/>", "GB894"),
        ("m.xml", GROWTH.replace('level="3" version="2"', 'level="1" version="2"'), "GB89"),
        ("m.cellml", "<model/>", "GB896"),
        ("m.xml", GROWTH.replace("<ci>x</ci>", "<ci>y</ci>"), "GB895"),
    ],
)
def test_refusals_have_a_code_and_write_nothing(here: Path, gbspec: Run, name: str, text: str, code: str) -> None:
    (here / name).write_text(text)
    result = gbspec("import", name, "-o", "out")
    assert result.exit_code == 1
    assert code in result.stderr
    assert not (here / "out").exists()


def test_a_package_that_is_missing_is_named_with_its_command(
    here: Path, gbspec: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    made.stored(here, GROWTH, "growth.xml")
    for name in [n for n in sys.modules if n.startswith("gbspec.imports")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "libsbml", None)
    result = gbspec("import", "growth.xml", "-o", "out")
    assert result.exit_code == 1
    assert "pip install 'gbspec[sbml]'" in result.stderr
