"""Whole solutions of exact data of which all states are measured: fitted where errors of intervals add up or grow."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data import Trajectories, Trajectory
from gbspec.runs import Run
from gbspec.training import TrainOptions, train
from gbspec.training.engines import Engine
from gbspec.training.optimise import LevenbergOptions
from gbspec.training.recipe import whole
from gbspec.training.recipe.context import build_context
from gbspec.training.recipe.planned import Reached
from gbspec.training.recipe.planning import plan
from gbspec.training.stages import StageName
from tests.training.conftest import model_of

GROWTH = """
model growth
time t
state x in [0, 5]
state y in [0, 5]
unknown r(x, y) by mlp(6)
x' = r - 0.1*x
y' = 0.3*x - 0.2*y
observe x
observe y
"""


def growth(rows: int = 41, end: float = 30.0) -> Trajectories:
    """Twelve populations x that grow fiftyfold, each with the food y that limits it, without noise."""
    rng, items = np.random.default_rng(0), []
    t = np.linspace(0, end, rows)
    for i in range(12):
        start = [rng.uniform(0.01, 0.05), rng.uniform(0.1, 0.3)]
        found = solve_ivp(slopes, (0, end), start, t_eval=t, rtol=1e-11, atol=1e-13, method="LSODA").y.T
        items.append(Trajectory(str(i), 0.0, t, found, np.ones_like(found), np.full_like(found, np.nan), np.zeros(0)))
    return Trajectories(tuple(items), ("x", "y"))


def rate(x: Array, y: Array) -> Array:
    return np.asarray(0.7 * x * (1 - 0.3 * y))


def slopes(t: float, z: Array) -> Array:
    return np.array([rate(z[0], z[1]) - 0.1 * z[0], 0.3 * z[0] - 0.2 * z[1]])


def stages(run: Run) -> list[str]:
    return [str(stage.name) for stage in run.fit.members[0].stages]


def error_of_rate(run: Run, data: Trajectories) -> float:
    """The root mean square error of the learned rate at the data."""
    from gbspec.backends import Evaluator

    points = np.concatenate([item.values for item in data.items])
    found = Evaluator(run.member()).functions_many("r", points)
    return float(np.sqrt(np.mean((found - rate(*points.T)) ** 2)))


@pytest.mark.usefixtures("quick_fits")
def test_errors_that_grow_along_solutions_are_fitted_away(tmp_path: Path) -> None:
    """Intervals have a loss below 1e-9, and whole solutions had one of 7e-7."""
    run = train(model_of(GROWTH), growth(), TrainOptions(workers=1), tmp_path / "run")
    (member,) = run.fit.members
    assert stages(run)[-1] == StageName.WHOLE
    assert member.loss is not None and member.loss < 3e-9
    assert member.interval_loss is not None and member.interval_loss < 3e-9


@pytest.mark.usefixtures("quick_fits")
def test_the_last_digits_of_first_values_are_not_made_up_for_by_functions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise of 0.004 % of a standard deviation is 0.1 % of the first values, which grow: with these held, the learned
    rate became nine times as wrong."""
    exact, rng = growth(), np.random.default_rng(1)
    size = np.concatenate([item.values for item in exact.items]).std(axis=0)
    data = replace(
        exact,
        items=tuple(
            replace(item, values=item.values + 4e-5 * size * rng.standard_normal(item.values.shape))
            for item in exact.items
        ),
    )
    with_whole = train(model_of(GROWTH), data, TrainOptions(workers=1), tmp_path / "with")
    monkeypatch.setattr(whole, "APART", np.inf)
    without = train(model_of(GROWTH), data, TrainOptions(workers=1), tmp_path / "without")
    assert (StageName.WHOLE in stages(with_whole), StageName.WHOLE in stages(without)) == (True, False)
    assert error_of_rate(with_whole, data) < 1.5 * error_of_rate(without, data)


@pytest.mark.parametrize(
    ("intervals", "solutions", "fitted"),
    [
        (1e-10, 9e-9, False),  # errors that add up, as in most fits
        (1e-10, 1.1e-8, True),
        (4e-8, 3e-7, False),  # noise, which both have
        (4e-8, 5e-7, True),
    ],
)
def test_whole_solutions_near_intervals_are_left_as_they_are(
    intervals: float, solutions: float, fitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = build_context(model_of(GROWTH), load_module(model_of(GROWTH)), growth(5), TrainOptions(), 0)
    parameters = context.parameters(
        {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    )

    def residuals(engine: Engine, theta: Array) -> Array:
        loss = intervals if engine.problem.forcing.weight.any() else solutions
        return np.full(3, np.sqrt(2 * loss))

    monkeypatch.setattr(whole, "residual_vector", residuals)
    made = whole.whole_of_exact_data(
        context, lambda _: parameters, "normal", lambda _: LevenbergOptions(), lambda _: True
    )
    theta = parameters.vector(context.module.weights)
    assert made.due(Reached(theta)) is fitted
    assert [stage.name for stage in plan(context, parameters)].count(StageName.WHOLE) == 1
