"""Fits in which the learned time of an event rests at a row: the sum of squares has a kink there, and no derivative
vanishes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import gbspec
from gbspec.arrays import Array
from gbspec.training.optimise.kinks import at_kinks

pytestmark = pytest.mark.usefixtures("quick_fits")

MODEL = """model break
time t from 0
state x in [0, 20]
learn r0 in [0.1, 3] = 0.6
learn r1 in [0.01, 3] = 0.6
learn d in [0.01, 1] = 0.3
learn tb in [4, 16] = 7
discrete r = r0
initial x = 2
x' = r - d*x
event change at tb: r = r1
observe x
"""
T = np.arange(1.0, 21.0)


def solution(r0: float, r1: float, d: float, tb: float) -> Array:
    """Growth towards r0/d until tb, towards r1/d after it."""
    before = r0 / d + (2 - r0 / d) * np.exp(-d * np.minimum(T, tb))
    return np.asarray(np.where(tb < T, r1 / d + (before - r1 / d) * np.exp(-d * (T - tb)), before))


@pytest.fixture(scope="module")
def table() -> Array:
    """A break at the row t = 10, whose value is above the solution: both sides of it fit worse."""
    noise = 0.05 * np.random.default_rng(3).standard_normal(len(T))
    return np.asarray(solution(1.0, 0.2, 0.1, 10.0) + noise + 0.25 * (T == 10.0))


def squares(y: Array, tb: float) -> float:
    """The least sum of squares with the break at tb."""
    fit = least_squares(lambda p: solution(*p, tb) - y, [1.0, 0.2, 0.1], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return 2 * float(fit.cost)


def test_the_rest_of_a_fit_is_finished_where_a_time_rests_at_a_row(tmp_path: Path, table: Array) -> None:
    assert min(squares(table, 9.99), squares(table, 10.01)) > squares(table, 10.0)
    (tmp_path / "break.gb").write_text(MODEL)
    rows = "".join(f"{t},{y!r}\n" for t, y in zip(T.tolist(), table.tolist(), strict=True))
    (tmp_path / "break.csv").write_text("t,x\n" + rows)
    run = gbspec.train(tmp_path / "break.gb", tmp_path / "break.csv", tmp_path / "run", effort="low")
    constants = run.constants
    assert constants["tb"] == pytest.approx(10.0, abs=1e-5)
    reached = float(np.sum((solution(**constants) - table) ** 2))
    assert reached == pytest.approx(squares(table, 10.0), rel=1e-6)
    assert "`tb` ended at 10, the row t = 10, where the sum of squares has a kink" in " ".join(run.notes())
    found = gbspec.open_run(tmp_path / "run").profile("tb")
    assert all(point.converged for point in found.points)
    assert found.low is not None
    assert found.high is not None
    assert found.noise is not None
    scale = found.threshold * found.noise**2 * np.var(table)
    for end in (found.low, found.high):
        assert squares(table, end) - squares(table, 10.0) == pytest.approx(scale, rel=0.1)


def test_times_of_single_trajectories_rest_at_rows_too(tmp_path: Path, table: Array) -> None:
    (tmp_path / "break.gb").write_text(
        MODEL.replace("learn tb in [4, 16] = 7", "learn tb in [4, 16] = 7 per trajectory")
    )
    rows = [(label, t, y) for label in "ab" for t, y in zip(T.tolist(), table.tolist(), strict=True)]
    (tmp_path / "break.csv").write_text("trajectory,t,x\n" + "".join(f"{a},{t},{y!r}\n" for a, t, y in rows))
    run = gbspec.train(tmp_path / "break.gb", tmp_path / "break.csv", tmp_path / "run", effort="low")
    constants = run.constants
    assert np.sum((solution(**constants) - table) ** 2) == pytest.approx(squares(table, 10.0), rel=1e-6)
    said = " ".join(run.notes())
    for label in "ab":
        assert f"`tb` ended at 10 in trajectory `{label}`, the row t = 10, where the sum of squares has a kink" in said


def test_a_kink_is_told_from_a_smooth_minimum_and_from_a_jump() -> None:
    """Beside the kink, which is a little off, the objective also falls along another entry."""

    def value(theta: Array) -> float:
        kink, smooth, jump, slope = theta
        rise = max(kink - 1e-7, 0.0) - 0.5 * min(kink - 1e-7, 0.0)
        return float(1 + rise + smooth**2 + math.copysign(0.1, jump) + abs(jump) + 0.3 * slope)

    assert at_kinks(value, np.zeros(4), [0, 1, 2, 3]) == [0]
