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
from gbspec.training.recipe.other_start import OtherStart
from tests.training.conftest import model_of, trajectory

TEXT = "model decay\ntime t from 0\nstate x in [0, 2]\nunknown f(x) by mlp(6)\nx' = -f\ninitial x = 1\nobserve x\n"


@pytest.mark.parametrize("start", ["saddle", "blown up", "warm"])
def test_the_better_end_of_two_starts_is_gone_on_with(start: str) -> None:
    """From zero weights least squares do not move, and from huge ones there is no solution."""
    random, times = np.random.default_rng(0), np.linspace(0.2, 3, 15)
    values = np.exp(-times) + 0.02 * random.standard_normal(15)
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    model = model_of(TEXT)
    options = TrainOptions(backend="torch", max_step=0.1, solver="rk4")
    ready = prepare(model, load_module(model, RK4), data, options, 0)
    engine = ready.context.engine(ready.parameters, 0.0)
    theta = {"saddle": 0 * ready.theta, "blown up": 1e8 * (1 + ready.theta), "warm": ready.theta}[start]
    plain = LevenbergOptions(tolerance=1e-3, ridge=1e-3, evidence=True)
    stage = OtherStart(engine, ready.theta, lambda _: plain, 15)
    outcome = stage.step(stage.begin(theta), 0)
    assert outcome.done
    if start == "warm":
        np.testing.assert_array_equal(outcome.state["theta"], theta)
    else:
        assert outcome.loss < 0.01
