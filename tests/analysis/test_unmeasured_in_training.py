"""Intervals of unmeasured states in the rows of the training: what is not known of the start and of the constants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from gbspec.analysis.prediction.forecast import forecast
from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

MODEL = """\
model two "A hidden state decays into a measured one"
state h in [0, 10] = 2
state x in [0, 10] = 1
learn k = 0.3 in [0.01, 5]
learn m = 0.1 in [0.001, 5]
h' = -k*h
x' = k*h - m*x
initial h learn
initial x = 0.5
observe x
"""
TIMES = np.linspace(0.0, 8.0, 25)
RATE, LOSS, START = 0.6, 0.15, 4.0


def solution(p: Array) -> Array:
    """h and x at the times [25, 2] for k, m, h(0)."""
    k, m, start = p
    h = start * np.exp(-k * TIMES)
    x = 0.5 * np.exp(-m * TIMES) + start * k / (k - m) * (np.exp(-m * TIMES) - np.exp(-k * TIMES))
    return np.stack([h, x], axis=1)


def test_a_state_that_was_not_measured_has_the_interval_of_the_linearised_model(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    values = solution(np.array([RATE, LOSS, START]))[:, 1] + 0.05 * rng.normal(size=len(TIMES))
    table = Trajectories((trajectory("a", 0.0, TIMES, values[:, None], []),), ("x",))
    train(model_of(MODEL), table, TrainOptions(workers=1), tmp_path / "run")
    shown = forecast(open_run(tmp_path / "run"), table).items[0]
    found = least_squares(lambda p: solution(p)[:, 1] - values, [RATE, LOSS, START], x_scale=[1, 1, 1])
    noise = np.sqrt(2 * found.cost / (len(TIMES) - 3))
    moves = np.stack(
        [(solution(found.x + d) - solution(found.x - d))[:, 0] / 2e-4 for d in 1e-4 * np.eye(3)], axis=1
    )  # of h
    sd = noise * np.sqrt(np.einsum("ri,ij,rj->r", moves, np.linalg.inv(found.jac.T @ found.jac), moves))
    assert shown.start.origin == "learned"
    np.testing.assert_allclose(shown.mean[:, 1], solution(found.x)[:, 0], atol=0.02 * START)
    np.testing.assert_allclose(shown.sd[:, 1], sd, rtol=0.15)
