"""Solutions that are compared, of trajectories whose inputs change at many times, are computed by equal steps where
these come to the solution of CVODES."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gbspec.analysis.prediction import nearby
from gbspec.analysis.prediction.nearby import Nearby, step_to_compare
from gbspec.analysis.prediction.solutions import Start, predict
from gbspec.arrays import Array
from gbspec.backends import Evaluator, load_module
from gbspec.data import Trajectory
from gbspec.data.trajectories import Signal
from gbspec.ir import RK4, Model
from tests.training.conftest import model_of, trajectory

TEXT = """\
model driven "A driven oscillator with an unknown friction"
input u held
state x in [-2, 2] = 0
state v in [-2, 2] = 0
learn k = 4 in [0.1, 1e6]
unknown f(v) by mlp(4)
x' = v
v' = u - k*x - f(v)
observe x
"""
ROWS = 120


def case(k: float) -> tuple[Model, Evaluator, Trajectory, Start]:
    """The model, a member with random weights, rows with an input that changes at each of them, and a start."""
    model, times = model_of(TEXT), np.linspace(0.0, 0.1 * (ROWS - 1), ROWS)
    member = load_module(model, RK4).random(0)
    force = np.asarray(np.random.default_rng(1).uniform(-1, 1, ROWS), dtype=np.float64)
    item = trajectory("a", 0.0, times, np.zeros((ROWS, 1)), [], inputs=(Signal(times, force),))
    return model, Evaluator(member), item, Start(np.array([0.5, 0.0]), np.array([k]), "known")


def slopes(near: Nearby) -> Array:
    """The derivatives of the solution by the initial velocity and by the constant [2, R, V]."""
    by_constant = (near.moved(1e-3, constant=0) - near.moved(-1e-3, constant=0)) / 2e-3
    return np.stack([near.slope(1.0, state=1), by_constant])


def test_derivatives_are_those_of_the_adaptive_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    model, evaluator, item, start = case(4.0)
    found = predict(evaluator, model, item, start)
    exact = slopes(Nearby(evaluator, model, item, found))
    near = Nearby(evaluator, model, item, found, 0.05)
    monkeypatch.setattr(nearby, "predict", None)  # no adaptive solution is computed
    size = np.abs(exact).max(axis=1, keepdims=True)
    assert np.all(np.abs(slopes(near) - exact) < 2e-3 * size)
    np.testing.assert_allclose(near.variables[:, 0], found.channels[:, 0], atol=1e-4)


def test_where_equal_steps_come_to_another_solution_they_are_not_used() -> None:
    model, evaluator, item, start = case(2e3)  # the oscillation has a period of 0.14
    found = predict(evaluator, model, item, start)
    near = Nearby(evaluator, model, item, found, 0.05)
    np.testing.assert_array_equal(near.solve(start), Nearby(evaluator, model, item, found).solve(start))


def test_equal_steps_are_considered_where_a_training_had_them_and_inputs_change_often() -> None:
    model, _, item, _ = case(4.0)

    def run(**changed: Any) -> Any:
        found = {"model": model, "step": 0.05, "tolerance": None, **changed}
        return SimpleNamespace(
            model=found["model"], equal_step=lambda number: found["step"], tolerance=lambda number: found["tolerance"]
        )

    assert step_to_compare(run(), 0, item) == 0.05
    assert step_to_compare(run(tolerance=1e-6), 0, item) is None
    assert step_to_compare(run(step=None), 0, item) is None
    switched = model_of(TEXT.replace("u - k*x", "if(t > k, u, 0) - k*x"))
    assert step_to_compare(run(model=switched), 0, item) is None
    few = Signal(item.inputs[0].times[:20], item.inputs[0].values[:20])
    assert step_to_compare(run(), 0, replace(item, inputs=(few,))) is None
