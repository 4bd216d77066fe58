"""Constants by which rows pass events: their sum of squares jumps, and their deviance is that of the best side."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import gbspec
from gbspec.training.optimise import Passing, Rest, beyond_jumps

pytestmark = pytest.mark.usefixtures("quick_fits")

MODEL = """model rises
time t from 0
state x in [0, 20]
learn k = 0.3 in [0.01, 2]
learn at = 3 in [1, 8]
learn jump = 1 in [0.1, 5]
event rise at at: x = x + jump
x' = -k*x
initial x = 3
observe x noise normal(0.15)
"""
T = np.tile(0.7 * np.arange(1, 15), 2)


def solution(k: float, at: float, jump: float) -> np.ndarray:
    return np.asarray(3 * np.exp(-k * T) + np.where(at < T, jump * np.exp(-k * (T - at)), 0.0))


Y = solution(0.2, 4.3, 2.0) + 0.15 * np.random.default_rng(4).standard_normal(len(T))


def squares(jump: float | None = None) -> float:
    """The least sum of squares, in the noise's unit, over times of the event between rows near the true one."""
    rows, found = np.unique(T), np.inf
    for low, high in pairwise(rows[4:8]):
        for at in np.linspace(low + 1e-9, high - 1e-9, 5):
            free = [0.2] if jump is not None else [0.2, 2.0]
            fit = least_squares(lambda p, at=at: (solution(p[0], at, p[1] if jump is None else jump) - Y) / 0.15, free)
            found = min(found, 2 * fit.cost)
    return found


def test_a_jump_at_a_learned_time_has_its_interval(tmp_path: Path) -> None:
    """Between two rows the time of the event is undetermined, and the jump with it as far as these rows allow."""
    (tmp_path / "rises.gb").write_text(MODEL)
    rows = (f"{i // 14},{t},{y}\n" for i, (t, y) in enumerate(zip(T, Y, strict=True)))
    (tmp_path / "rises.csv").write_text("trajectory,t,x\n" + "".join(rows))
    run = gbspec.train(tmp_path / "rises.gb", tmp_path / "rises.csv", tmp_path / "run", effort="low")
    said = " ".join(run.notes())
    assert "`jump` is not determined" not in said
    assert "`at` and `jump` have no interval" in said
    found = gbspec.open_run(tmp_path / "run").profile("jump")
    assert found.noise is not None
    assert found.low is not None
    assert found.high is not None
    scale = 0.15**2 / (found.noise**2 * np.var(Y))
    for end in (found.low, found.high):
        assert (squares(end) - squares()) * scale == pytest.approx(found.threshold, rel=0.1)


def test_several_such_constants_are_gone_through_in_turn() -> None:
    """The sum of squares is low only where both are between two rows, and falls up to the edge of one of these."""

    def objective(theta: np.ndarray) -> float:
        jumps = 100.0 * (not 0.2 < theta[1] < 0.5) + 50.0 * (not -3.0 < theta[2] < -2.6)
        return float(1.0 - theta[1] + 0.1 * theta[2] ** 2 + jumps)

    def fit(theta: np.ndarray, held: tuple[int, ...]) -> Rest:
        return Rest(theta, objective(theta), 0.0 if len(held) == 3 else 1.0, 0)

    begun = np.array([7.0, 0.9, 0.0])
    passing = Passing((1, 2), (np.linspace(-1, 1, 16), np.linspace(-4, 4, 33)))
    found = beyond_jumps(fit, objective, fit(begun, (0,)), 0, passing, 1e-3)
    assert found.theta == pytest.approx([7.0, 0.5, -2.6], abs=2e-3)
    assert found.promised == 0.0
