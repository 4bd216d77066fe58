"""The declared range of a state that nothing else gives a size scales the inputs of unknown functions."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.training import TrainOptions
from gbspec.training.recipe import build_context
from gbspec.training.starts import eliminate, network_scales
from tests.training.conftest import model_of, trajectory

HIDDEN = """
model hidden
time t
state x
state w{state}
unknown f(x, w{argument})
x' = -x + f(x, w)
w' = x - w
observe x
"""


CULTURE = """
model culture
time t
state X
state S in [0, 20] = 10
unknown mu(S) >= 0
X' = mu*X
S' = -2*mu*X
observe X
"""


@pytest.mark.parametrize("more", ["", "observe rate = X'\n"])
def test_the_size_of_an_unknown_comes_from_the_balances_of_measured_states(more: str) -> None:
    """The balance of an unmeasured state, whose slope is a guess of zero, would be met by an unknown that is zero."""
    model = model_of(CULTURE + more)
    t = np.linspace(0.0, 5.0, 30)
    values = np.stack([np.exp(0.4 * t), 0.4 * np.exp(0.4 * t)], axis=1)[:, : len(model.channels)]
    data = Trajectories((trajectory("1", 0.0, t, values, []),), tuple(c.name for c in model.channels))
    context = build_context(model, load_module(model), data, TrainOptions(), 0)
    eliminated = eliminate(model, context.module, context.points, np.zeros(0))
    assert np.median(eliminated.outputs) == pytest.approx(0.4, rel=0.05)


EPIDEMIC = """
model epidemic
time t
state S in [0, 5e6]
state I in [0, 1e5]
unknown beta(t in [0, 280]) >= 0
S' = -beta(t)*S*I/5e6
I' = beta(t)*S*I/5e6 - 0.2*I
initial S = 5e6 - 80
initial I = 80
observe weekly = 7*beta(t)*S*I/5e6 noise lognormal(0.08)
"""


def test_a_balance_of_unknown_terms_alone_does_not_say_that_these_are_zero() -> None:
    """No state is measured: sizes follow from ranges, and from the other balance (true rates are 0.1 to 0.35)."""
    model = model_of(EPIDEMIC)
    t = np.linspace(7.0, 280.0, 40)
    values = (1e3 + 50 * t)[:, None]
    data = Trajectories((trajectory("1", 0.0, t, values, []),), ("weekly",))
    context = build_context(model, load_module(model), data, TrainOptions(), 0)
    scales = network_scales(model, eliminate(model, context.module, context.points, np.zeros(0)))
    assert 0.05 < scales["network.beta.output_center"][0] < 1
    assert 0.005 < scales["network.beta.output_scale"][0] < 1


@pytest.mark.parametrize(
    ("state", "argument", "low", "high"),
    [(" in [-15, 25]", "", -15, 25), (" in [-15, 25]", " in [2, 4]", 2, 4), ("", "", -1, 1)],
)
def test_a_hidden_state_is_scaled_by_its_range(state: str, argument: str, low: float, high: float) -> None:
    model = model_of(HIDDEN.format(state=state, argument=argument))
    t = np.linspace(0.0, 5.0, 60)
    data = Trajectories((trajectory("1", 0.0, t, (3 + np.sin(t))[:, None], []),), ("x",))
    context = build_context(model, load_module(model), data, TrainOptions(), 0)
    found = network_scales(model, eliminate(model, context.module, context.points, np.zeros(0)))
    center, scale, least, largest = (
        found[f"network.{model.networks[0].name}.input_{name}"] for name in ("center", "scale", "low", "high")
    )
    assert scale[1] == pytest.approx((high - low) / np.sqrt(12), rel=0.05)
    if state and not argument:
        assert center[1] == pytest.approx((low + high) / 2, abs=0.05 * (high - low))
        assert (least[1], largest[1]) == pytest.approx((low, high), abs=0.05 * (high - low))
    assert scale[0] == pytest.approx(np.sin(t).std(), rel=0.1), "that of a measured state is its data's"
