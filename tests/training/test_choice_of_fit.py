"""Whole solutions are said to follow the data less well than intervals only where they clearly do."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.ir import RK4
from gbspec.training import TrainOptions
from gbspec.training.engines import residual_vector
from gbspec.training.problem import mean_loss
from gbspec.training.recipe import prepare
from gbspec.training.recipe.preparation import Prepared
from gbspec.training.recipe.stages import ChoiceOfFit
from gbspec.training.runs.deviations import said_of_left
from tests.training.conftest import model_of, trajectory

TEXT = "model decay\ntime t from 0\nstate x in [0, 2]\nunknown f(x) by mlp(6)\nx' = -f\ninitial x = 1\nobserve x\n"


def prepared() -> Prepared:
    """A model of a network, and 40 values of a decay with noise."""
    random, times = np.random.default_rng(0), np.linspace(0.1, 3, 40)
    values = np.exp(-times) + 0.02 * random.standard_normal(40)
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    model = model_of(TEXT)
    options = TrainOptions(backend="torch", max_step=0.1, solver="rk4")
    return prepare(model, load_module(model, RK4), data, options, 0)


@pytest.mark.parametrize(("share", "said"), [(0.9999, False), (0.7, False), (0.1, True)])
def test_a_ratio_that_chance_explains_is_no_reason(share: float, said: bool) -> None:
    """Of 40 values, the means of squares of the same noise differ by a fifth, and by two thirds in one of 300 cases."""
    ready = prepared()
    whole = ready.context.engine(ready.parameters, 0.0)
    loss = mean_loss(residual_vector(whole, ready.theta))
    stage = ChoiceOfFit(lambda theta: share * loss, whole, ready.theta, 0)
    assert bool(stage.step(stage.begin(ready.theta), 0).note) is said


@pytest.mark.parametrize(("better", "told"), [(True, True), (False, False)])
def test_a_better_fit_of_whole_solutions_that_is_left_is_told(better: bool, told: bool) -> None:
    """Of a heated plate it had 42 % less loss, and predicted other rows with a third of the error."""
    ready = prepared()
    whole = ready.context.engine(ready.parameters, 0.0)
    good, bad = ready.theta, ready.theta.copy()
    bad[: ready.parameters.n_weights] = 0.0  # the solution stays where it begins
    losses = [mean_loss(residual_vector(whole, theta)) for theta in (good, bad)]
    assert losses[0] < 0.5 * losses[1]
    late, earlier = (good, bad) if better else (bad, good)
    stage = ChoiceOfFit(lambda theta: 1e-3 * losses[0] * (1e-6 if theta is earlier else 1.0), whole, earlier, 0)
    assert "the fit of intervals was kept" in stage.step(stage.begin(late), 0).note
    said = " ".join(said_of_left(whole, earlier, late))
    assert (f"which was left, it is {losses[0]:.3g}. `--forcing autoregressive` fits whole" in said) is told


@pytest.mark.parametrize(
    ("late", "earlier", "margin", "kept"),
    [
        ((1.0, 2.1), (1.0, 3.0), 1.0, True),  # whole solutions gather 2.1 times the loss; sqrt(2.1) is 1.449
        ((1.0, 2.1), (1.0, 3.1), 1.0, False),
        ((1.0, 1.9), (1.0, 2.0), 1.0, False),  # not clearly disturbed: the product decides
        ((1.0, 1.9), (0.9, 2.0), 1.0, True),
        ((1.0, 100.0), (1.0, 990.0), 1.0, True),
        ((1.0, 100.0), (1.0, 1010.0), 1.0, False),
        ((1.0, 100.0), (1.0, 570.0), 3.0, True),  # of segments: sqrt(100/3) is 5.77
        ((1.0, 100.0), (1.0, 580.0), 3.0, False),
        ((1.0, np.inf), (1.0, 5.0), 1.0, True),  # whole solutions that blow up
        ((1.0, 5.0), (1.0, np.inf), 1.0, False),
        ((1.0, 5.0), (np.nan, np.nan), 1.0, False),
        ((1.0, 5.0), (0.0, 9.0), 1.0, True),
    ],
)
def test_the_fit_of_intervals_is_kept_in_a_disturbed_system(
    late: tuple[float, float], earlier: tuple[float, float], margin: float, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Losses of intervals and of whole solutions, of the fit of whole solutions and of that of intervals."""
    ready = prepared()
    whole, other = ready.context.engine(ready.parameters, 0.0), ready.theta + 0.1
    stage = ChoiceOfFit(lambda theta: 0.0, whole, other, 0, margin)
    monkeypatch.setattr(ChoiceOfFit, "_losses", lambda self, a, b: late if a is ready.theta else earlier)
    found = stage.step({"theta": ready.theta}, 0)
    assert (found.state["theta"] is not ready.theta) is kept
    assert ("was kept" in found.note) is kept
