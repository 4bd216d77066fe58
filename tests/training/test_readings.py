"""States that formulas of channels show: curves, first values, and the scales of functions of what nothing measures."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gbspec.backends.module import load_module
from gbspec.data import Signal, Trajectories, Trajectory
from gbspec.training import TrainOptions
from gbspec.training.recipe import build_context, initial
from gbspec.training.starts.readings import readings
from tests.training.conftest import model_of

VIRUS = (
    "model virus\ntime t\nstate T in [0, 1e6]\nstate V in [1, 1e8]\ncondition e\nlearn c in [1, 50]\n"
    "unknown s(T) by mlp(4)\nT' = 1e4*s - 1e-8*T*V\nV' = (1 - e)*T - c*V\n"
)


@pytest.mark.parametrize(
    ("declared", "formula", "measured", "state"),
    [
        ("in [0, 9]", "x - 2", 3.0, 5.0),
        ("in [0, 9]", "2*exp(-x/3)", 0.5, 3 * np.log(4)),
        ("in [0, 9]", "log(x)/log(10)", 0.5, 10**0.5),
        ("in [0, 9]", "1 + e*sqrt(x)", 2.0, 0.25),
        ("", "x^3", -8.0, -2.0),
        ("in [0, 9]", "x - 2", 30.0, 9.0),
        ("in [0, 9]", "1/x", 0.0, np.nan),
        ("", "x^2", 4.0, None),
        ("", "x + x^3", 4.0, None),
        ("", "a*x", 4.0, None),
        ("", "x + y", 4.0, None),
        ("", "f(x)", 4.0, None),
    ],
)
def test_a_formula_of_one_state_is_inverted(declared: str, formula: str, measured: float, state: float | None) -> None:
    text = f"model m\nstate x {declared}\nstate y\ncondition e\nlearn a = 1\nunknown f(x) by mlp(2)\nx' = -x + f*y\n"
    found = readings(model_of(f"{text}y' = -a*y\nobserve r = {formula}\n"))
    if state is None:
        assert not found
        return
    (value,) = found[0].values(np.array([measured]), np.array([2.0]))
    assert value == pytest.approx(state, nan_ok=True)


def test_a_state_with_a_channel_of_its_own_needs_no_formula() -> None:
    assert not readings(model_of("model m\nstate x\nx' = -x\nobserve x\nobserve r = log(x)\n"))


def data_of(channel: str, values: list[float]) -> Trajectories:
    y = np.array(values)[:, None]
    count, sd = np.ones(y.shape), np.full(y.shape, np.nan)
    return Trajectories(
        (Trajectory("1", 0.0, np.arange(len(y), dtype=float), y, count, sd, np.array([0.9])),), (channel,)
    )


def test_what_a_logarithm_shows_is_where_solutions_begin() -> None:
    model = model_of(VIRUS + "observe y = log(V)/log(10)\n")
    context = build_context(model, load_module(model), data_of("y", [6.0, 5.5, 5.0, 4.0]), TrainOptions(), 0)
    parameters, theta = initial(context)
    assert parameters.starts(torch.from_numpy(theta)).numpy()[0].tolist() == pytest.approx([5e5, 1e6])


@pytest.mark.parametrize("observed", ["observe y = log(V)/log(10)\n", "learn a = 1\nobserve y = a*V\n"])
def test_functions_of_what_nothing_measures_have_the_scale_of_its_range(observed: str) -> None:
    """Without any measured state the scale had been 1, the slope of a random network a million times too large."""
    model = model_of(VIRUS + observed)
    context = build_context(model, load_module(model), data_of("y", [6.0, 5.5, 5.0, 4.0]), TrainOptions(), 0)
    parameters, theta = initial(context)
    scale = parameters.weights(torch.from_numpy(theta))["network.s.input_scale"]
    assert float(scale) == pytest.approx(1e6 / np.sqrt(12), rel=0.1)


@pytest.mark.filterwarnings("error")  # of a division by a scale of zero, after which sizes were lost
def test_functions_in_balances_of_what_nothing_measures_have_the_size_of_the_other_terms() -> None:
    """An elimination beside infusions of 10 to 90 had the scale 1, and ended at zero from all random weights."""
    model = model_of(
        "model pk\ntime t from 0\nstate a in [0, 100]\ninput rate held\nlearn V in [1, 100]\n"
        "unknown el(c in [0, 10]) >= 0, zero at c = 0 by mlp(4)\nlet c = a/V\na' = rate - el(c)\ninitial a = 0\n"
        "observe y = c\n"
    )
    times, y = np.arange(6.0), np.array([[1.0], [3.0], [4.0], [2.0], [1.0], [0.5]])
    rate = Signal(np.array([0.0, 2.0]), np.array([90.0, 10.0]))
    item = Trajectory("1", 0.0, times, y, np.ones(y.shape), np.full(y.shape, np.nan), np.zeros(0), (rate,))
    context = build_context(model, load_module(model), Trajectories((item,), ("y",)), TrainOptions(), 0)
    parameters, theta = initial(context)
    scale = parameters.weights(torch.from_numpy(theta))["network.el.output_scale"]
    assert 10 < float(scale[0]) < 100
