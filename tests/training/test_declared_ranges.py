"""The declared range of a state that nothing else gives a size scales the inputs of unknown functions."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data import Signal, Trajectories
from gbspec.diagnostics import Findings
from gbspec.passes import with_contracts
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


SENSED = """
model sensed
time t
input u held
state x
state w{state}
unknown f({formal}){contract}
x' = u - x
w' = (u - w)/3
{between}observe x
observe y = {channel}
"""


def sensed_scales(**parts: str) -> dict[str, np.ndarray]:
    """The scales of `f`, of which only a channel says anything, from 60 rows with u between 40 and 60."""
    filled = {"state": "", "formal": "w", "contract": "", "between": "", "channel": "f(w)"} | parts
    model = with_contracts(model_of(SENSED.format(**filled)), Findings())
    t = np.linspace(0.0, 5.0, 60)
    u = np.where(t < 2.5, 40.0, 60.0)
    values = np.stack([50 + np.sin(t), np.cos(t)], axis=1)
    item = trajectory("1", 0.0, t, values, [], inputs=(Signal(t, u),))
    context = build_context(model, load_module(model), Trajectories((item,), ("x", "y")), TrainOptions(), 0)
    found = network_scales(model, eliminate(model, context.module, context.points, np.zeros(len(model.learnables))))
    return {name.rsplit("_", 1)[1]: value for name, value in found.items() if "input_" in name}


@pytest.mark.parametrize(
    ("parts", "low", "high"),
    [
        ({}, -10, 100),
        ({"contract": " >= 0, convex in w"}, -10, 100),
        ({"contract": " = 1 + nn"}, -10, 100),
        ({"contract": " by spline(8)"}, -10, 100),
        ({"between": "let q = f(w)\n", "channel": "2*q"}, -10, 100),
        ({"channel": "f(w/10 - 3)"}, -4, 7),
        ({"formal": "w in [20, 80]"}, 20, 80),
        ({"formal": "v in [20, 80]"}, 20, 80),
    ],
)
def test_a_function_that_only_a_channel_has_is_scaled_by_the_range_of_a_hidden_state(
    parts: dict[str, str], low: float, high: float
) -> None:
    found = sensed_scales(state=" in [-10, 100]", **parts)
    assert found["scale"] == pytest.approx((high - low) / np.sqrt(12), rel=0.05)
    assert found["center"] == pytest.approx((low + high) / 2, abs=0.05 * (high - low))
    assert (found["low"], found["high"]) == pytest.approx((low, high), abs=0.05 * (high - low))


def test_each_argument_of_such_a_function_has_the_scale_of_what_it_is() -> None:
    parts = {"formal": "w, v, s", "channel": "f(w, u, x)"}
    found = sensed_scales(state=" in [-10, 100]", **parts)
    assert found["scale"] == pytest.approx([110 / np.sqrt(12), 10, np.sin(np.linspace(0, 5, 60)).std()], rel=0.1)
    assert found["center"][1:] == pytest.approx([50, 50], abs=1)


def test_an_angle_that_only_a_channel_has_gets_the_scale_of_a_cosine() -> None:
    found = sensed_scales(state=" in [-10, 100]", formal="w, v", contract=" period 24 in v", channel="f(w, t)")
    assert found["scale"] == pytest.approx([110 / np.sqrt(12), np.sqrt(0.5)], rel=0.05)


REFILLED = """
model refilled
time t
state x
state z in [10, 40]
unknown f(z) >= 0
x' = -0.1*x
z' = -0.1*z
event refill when x < 0.5: x = f(z)
observe x
"""


def test_a_function_that_only_an_event_has_is_scaled_too() -> None:
    model = model_of(REFILLED)
    t = np.linspace(0.0, 5.0, 60)
    data = Trajectories((trajectory("1", 0.0, t, np.exp(-0.1 * t)[:, None], []),), ("x",))
    context = build_context(model, load_module(model), data, TrainOptions(), 0)
    found = network_scales(model, eliminate(model, context.module, context.points, np.zeros(0)))
    assert found["network.f.input_scale"][0] == pytest.approx(30 / np.sqrt(12), rel=0.05)
