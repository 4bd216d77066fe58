"""Learned thresholds beside an unknown function, from starts that no solution reaches."""

from __future__ import annotations

from pathlib import Path

import pytest

import gbspec
from gbspec.backends.native import CompilerError
from gbspec.backends.native.compiler import find_compiler
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.training.recipe.thresholds import learned_thresholds

try:
    find_compiler()
except CompilerError as error:
    pytest.skip(str(error), allow_module_level=True)

PUMP = """model pump "A tank that a pump fills between two levels, outflow unknown"
time t
input draw in [0, 1] held
state h in [0, 4]
discrete on = 0
learn low = 0.3 in [0.1, 1.4]
learn high = 3.8 in [1.5, 4]
learn feed = 0.5 in [0.1, 3]
unknown out(h) >= 0, increasing in h by mlp(4)
h' = feed*on - draw*out
event starts when h <= low: on = 1
event stops when h >= high: on = 0
observe h
truth low = 1
truth high = 2.5
truth feed = 0.9
truth out = 0.6*sqrt(max(h, 0))
"""


def test_the_constants_of_conditions_are_found(tmp_path: Path) -> None:
    path = tmp_path / "pump.gb"
    path.write_text(PUMP)
    assert learned_thresholds(load_model(path, Findings())) == ["low", "high"]


def test_thresholds_that_no_solution_reaches_are_searched(tmp_path: Path) -> None:
    """No solution reaches the declared thresholds, where their derivatives are zero: fits stayed there."""
    path = tmp_path / "pump.gb"
    path.write_text(PUMP)
    data = gbspec.simulate(
        path,
        trajectories=4,
        span=20,
        dt=0.5,
        noise=0.02,
        seed=3,
        initial={"h": (1.2, 2.4)},
        condition={"draw": (0.4, 1)},
    )
    run = gbspec.train(path, data, tmp_path / "run", backend="native", threads=1).run
    constants = {name: one.value for name, one in run.fit.constants.items()}
    assert constants == pytest.approx({"low": 1.0, "high": 2.5, "feed": 0.9}, rel=0.02)
    assert not [text for text in run.fit.warnings if "never happens" in text]
