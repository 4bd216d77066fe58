"""Whole solutions of few data are fitted from the warm start too, and the evidence chooses."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.ir import RK4
from gbspec.training import TrainOptions
from gbspec.training.optimise import LevenbergOptions
from gbspec.training.recipe import prepare
from gbspec.training.recipe.other_start import OtherStart, other_starts
from gbspec.training.recipe.planned import Planned, Reached
from gbspec.training.stages import StageName
from tests.training.conftest import model_of, trajectory

TEXT = "model decay\ntime t from 0\nstate x in [0, 2]\nunknown f(x) by mlp(6)\nx' = -f\ninitial x = 1\nobserve x\n"


def test_the_better_end_of_two_starts_is_gone_on_with() -> None:
    """Zero weights, from which least squares do not move, are left; what was found from the other start stays."""
    random, times = np.random.default_rng(0), np.linspace(0.2, 3, 15)
    values = np.exp(-times) + 0.02 * random.standard_normal(15)
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    model = model_of(TEXT)
    options = TrainOptions(backend="torch", max_step=0.1, solver="rk4")
    ready = prepare(model, load_module(model, RK4), data, options, 0)
    engine = ready.context.engine(ready.parameters, 0.0)
    stage = OtherStart(engine, ready.theta, LevenbergOptions(tolerance=1e-3, ridge=1e-3, evidence=True), 15)
    first = stage.step(stage.begin(0 * ready.theta), 0)
    assert first.done
    assert first.loss < 0.01
    again = stage.step(first.state, 0)
    np.testing.assert_array_equal(again.state["theta"], first.state["theta"])


def test_a_start_without_a_solution_changes_nothing() -> None:
    data = Trajectories((trajectory("1", 0.0, [0.5, 1.0], [[0.6], [0.4]], []),), ("x",))
    model = model_of(TEXT)
    ready = prepare(model, load_module(model, RK4), data, TrainOptions(backend="torch", max_step=0.1, solver="rk4"), 0)
    engine = ready.context.engine(ready.parameters, 0.0)
    stage = OtherStart(engine, 1e8 * (1 + ready.theta), LevenbergOptions(ridge=1e-3), 15)
    np.testing.assert_array_equal(stage.step(stage.begin(ready.theta), 0).state["theta"], ready.theta)


@pytest.mark.parametrize("better", [True, False])
def test_a_vector_before_growing_horizons_is_gone_on_with_where_it_was_better(better: bool) -> None:
    """Of a snowy catchment whole solutions had a loss of 0.45 before growing horizons, and of 0.53 at the end."""
    times = np.linspace(0.2, 3, 15)
    data = Trajectories((trajectory("1", 0.0, times, np.exp(-times)[:, None], []),), ("x",))
    model = model_of(TEXT)
    ready = prepare(model, load_module(model, RK4), data, TrainOptions(backend="torch", max_step=0.1, solver="rk4"), 0)
    good, bad = ready.theta, ready.theta.copy()
    bad[: ready.parameters.n_weights] = 0.0  # the solution stays where it begins
    before, now = (good, bad) if better else (bad, good)
    marks = {StageName.TEACHER: bad, StageName.STARTS_AGAIN: before, StageName.HORIZONS: now,
             StageName.AUTOREGRESSIVE: now}  # fmt: skip
    reached = Reached(now, {name.value: theta for name, theta in marks.items()})

    def unused(_: object) -> LevenbergOptions:
        raise AssertionError("nothing is fitted from the warm start")

    fit = Planned(StageName.AUTOREGRESSIVE, 10, lambda _: unused(_))  # type: ignore[arg-type,return-value]  # not made
    back, again = other_starts(ready.context, ready.parameters, fit, unused, 0)
    assert back.possible(reached) is better
    if better:
        stage = back.make(reached)
        found = stage.step(stage.begin(now), 0).state["theta"]
        np.testing.assert_array_equal(found, good)
        marked = Reached(found, {**reached.marks, StageName.OTHER_START.value: found})
        assert again.possible(marked), "whole solutions are fitted from there"
    assert not again.possible(reached)
