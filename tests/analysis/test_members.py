"""`bifurcate --members all`: every member is drawn; intervals of Hopf points and folds; ends of trained ranges."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gbspec import frontend
from gbspec.backends.module import load_module
from gbspec.cli.app import build
from gbspec.diagnostics import Findings
from gbspec.operations import analysing, models
from gbspec.report import files as figures
from gbspec.report.figures import diagram
from tests.analysis.conftest import model_of, nearly_true


def call(*arguments: object) -> Any:
    return CliRunner().invoke(build(("bifurcate",)), ["bifurcate", *map(str, arguments)])


def test_every_member_is_drawn_and_gives_an_interval(
    write_run: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_run(model_of("urp_gb2"), *(nearly_true({"B": B}) for B in (11.0, 11.1)))
    drawn: list[int] = []
    plain = figures.diagram
    monkeypatch.setattr(
        figures, "diagram", lambda shown, others, truth: drawn.append(1 + len(others)) or plain(shown, others, truth)
    )
    monkeypatch.setattr(analysing, "true_diagram", lambda *asked, cycles, doublings: None)
    asked = (run.path, "--over", "Da", "--range", 0.15, 0.3, "--json")
    result = call(*asked, "--members", "all", "-o", tmp_path / "members.svg")
    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)
    assert drawn == [2]
    (point,) = found["special"]
    low, high = point["interval"]
    # With a larger heat of reaction, oscillations begin at smaller Da: half a percent for one percent in B.
    assert point["type"] == "hopf"
    assert point["value"] == high
    assert 1e-3 < high - low < 1e-2
    # The document has the trained range and the points outside it.
    assert found["trained"] == [0.2, 0.5]
    for branch in found["branches"]:
        for place in branch["points"]:
            assert ("Da" in place["outside"]) is (place["value"] < 0.2 - 1e-6)


CUSP = """\
model cusp "The cusp normal form with a learned slope"
state x in [-2, 2] = 0
condition h in [-1, 1]
learn r = 1 in [0.1, 3]
x' = h + r*x - x^3
observe x
truth r = 1
"""


def cusp_run(write_run: Callable[..., Any], tmp_path: Path, *slopes: float) -> Any:
    """A run of the cusp whose members learned the given slopes."""
    source = tmp_path / "cusp.gb"
    source.write_text(CUSP)
    model = frontend.load_model(str(source), Findings())
    module = load_module(model)
    weights = [{**module.random(0).weights, "constants": np.array([r])} for r in slopes]
    return write_run(model, *(module(one, {"max_step": 0.1}) for one in weights))


def test_folds_get_an_interval_over_the_members(write_run: Callable[..., Any], tmp_path: Path) -> None:
    slopes = (1.0, 0.96, 1.05)
    run = cusp_run(write_run, tmp_path, *slopes)
    result = call(run.path, "--over", "h", "--range", -1, 1, "--members", "all", "--json")
    assert result.exit_code == 0, result.stderr
    below, above = (point for point in json.loads(result.stdout)["special"] if point["type"] == "fold")
    # Folds of h + r x - x^3 are at h = -+ 2 (r/3)^(3/2) (Strogatz, section 3.6).
    ends = [2.0 * (r / 3.0) ** 1.5 for r in slopes]
    assert above["value"] == pytest.approx(ends[0], abs=1e-8)
    assert above["interval"] == pytest.approx([min(ends), max(ends)], abs=1e-8)
    assert below["interval"] == pytest.approx([-max(ends), -min(ends)], abs=1e-8)


def test_members_that_disagree_on_a_fold_give_it_no_interval(write_run: Callable[..., Any], tmp_path: Path) -> None:
    run = cusp_run(write_run, tmp_path, 1.0, 2.5)
    # The second member's folds, at h = -+ 1.52, are outside the range.
    result = call(run.path, "--over", "h", "--range", -1, 1, "--members", "all", "--json")
    folds = [point for point in json.loads(result.stdout)["special"] if point["type"] == "fold"]
    assert [point["value"] for point in folds] == pytest.approx([-0.3849002, 0.3849002], abs=1e-7)
    assert [point["interval"] for point in folds] == [None, None]


def test_the_axes_of_a_diagram_have_units(tmp_path: Path) -> None:
    text = "model m\ntime t : s\nstate x : mol/L in [0, 5] = 1\nconst k : 1/s = 1\nconst f : mol/L/s = 1\n"
    (tmp_path / "m.gb").write_text(text + "x' = f - k*x\nobserve x\n")
    found = analysing.bifurcate(models.subject(tmp_path / "m.gb", {}, Findings()), "f", 0.5, 2.0)
    panel = diagram.figure(found).rows[0][0].rows[0].panels[0]
    assert (panel.x.unit, panel.y.unit) == ("mol/L/s", "mol/L")
