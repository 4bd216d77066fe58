"""Solutions of the evaluator that slide along a switch, in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.arrays import Array
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.diagnostics import ComputationError
from tests.switches.models import FRICTION
from tests.training.conftest import model_of

TIMES = np.array([0.0, 0.2, 0.5, 1.0, 1.5, 2.0])
HELD = """model held
time t from 0
state A
state B
A' = {}
B' = if(A >= 0.9, 0, 1)
initial A = 0.5
initial B = 0
observe A
"""


def solved(text: str, start: list[float]) -> Array:
    return Evaluator(load_module(model_of(text))()).integrate(start, TIMES)


@pytest.mark.parametrize(
    "rate", ["if(A >= 0.9, -1, 1)", "sign(0.9 - A)", "if(A < 0.9, 1, if(A >= 0.9, -1, 1000 + sqrt(A - 0.9)))"]
)
def test_a_relay_keeps_its_threshold_with_half_of_both_sides(rate: str) -> None:
    """The third value of the last choice is never taken: both comparisons are of one switch."""
    found = solved(HELD.format(rate), [0.5, 0.0])
    assert found[:, 0] == pytest.approx(np.minimum(0.5 + TIMES, 0.9), abs=1e-7)
    assert found[:, 1] == pytest.approx(np.minimum(TIMES, 0.4 + 0.5 * (TIMES - 0.4)), abs=1e-7)


def test_a_solution_leaves_its_switch_where_one_side_leads_away() -> None:
    """From t = 1.25 on both sides lead upwards."""
    found = solved(HELD.format("0.8*t + if(A >= 0.9, -1, 1)"), [0.5, 0.0])
    rises = 0.9 + 0.4 * TIMES**2 - TIMES - (0.625 - 1.25)
    expected = np.where(TIMES < 1.25, np.minimum(0.5 + TIMES + 0.4 * TIMES**2, 0.9), rises)
    assert found[:, 0] == pytest.approx(expected, abs=1e-6)


def test_what_sticks_stays_where_it_is() -> None:
    text = FRICTION.replace("learn c = 2.0 in [0, 5]", "const c = 2.0").replace(
        "learn k = 4.0 in [1, 10]", "const k = 4"
    )
    found = solved(text, [0.3, 0.1])
    assert found[-1] == pytest.approx(found[-2], abs=1e-7)
    assert found[-1, 1] == pytest.approx(0.0, abs=1e-7)


def test_what_blows_up_beside_a_switch_is_still_told() -> None:
    with pytest.raises(ComputationError, match="it blows up"):
        solved(HELD.format("if(A >= 0.9, 9*A^2, 1)"), [0.5, 0.0])


FITTED = """model fitted
time t from 0
state A in [0, 2]
learn th = 0.7 in [0.2, 1.5]
learn up = 0.7 in [0.1, 3]
A' = if(A >= th, -1, up)
initial A = 0.5
observe A
"""


@pytest.mark.usefixtures("quick_fits")
def test_a_fit_that_slides_is_validated_and_told_by_its_switch(tmp_path: Path) -> None:
    times = np.linspace(0.1, 2.0, 20)
    noisy = np.minimum(0.5 + times, 0.9) + 0.01 * np.random.default_rng(3).standard_normal(20)
    (tmp_path / "fitted.gb").write_text(FITTED)
    (tmp_path / "rows.csv").write_text("t,A\n" + "".join(f"{a},{b}\n" for a, b in zip(times, noisy, strict=True)))
    run = gbspec.train(tmp_path / "fitted.gb", tmp_path / "rows.csv", tmp_path / "run", effort="low")
    told = " ".join((tmp_path / "run" / "fit.json").read_text().split())
    assert "before an event or a dose" not in told
    assert "where the sum of squares jumps: a right side switches" in told
    score = run.validate().channels["A"]
    assert score.n == 20 and score.rmse < 0.02
