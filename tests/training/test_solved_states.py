"""States that nothing measures and no range bounds have the size that solutions of the model give them."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data import Signal, Trajectories
from gbspec.training import TrainOptions
from gbspec.training.recipe import build_context, prepare
from gbspec.training.recipe.solved_states import solved_states, with_solved_states
from tests.training.conftest import model_of, trajectory

MODEL = """
model followed
time t
input u held
state w
state v
learn tau = 0.5 in [0.1, 20]
unknown f(v)
w' = (u - w)/tau
v' = w - v
observe y = f(v)
"""


@pytest.mark.parametrize("warm_start", [True, False])
def test_an_argument_without_a_range_has_the_size_of_solutions(warm_start: bool) -> None:
    """Both states follow the input, 280 or 290; they begin at the guess of zero."""
    t = np.linspace(0.0, 400.0, 401)
    u = np.where(t % 40 < 20, 280.0, 290.0)
    item = trajectory("1", 0.0, t, np.cos(t)[:, None], [], inputs=(Signal(t, u),))
    model = model_of(MODEL)
    options = TrainOptions(warm_start=warm_start)
    scales = prepare(model, load_module(model), Trajectories((item,), ("y",)), options, 0).parameters.fixed
    assert scales["network.f.input_center"][0] == pytest.approx(285, abs=1.5)
    assert 4 < scales["network.f.input_scale"][0] < 15
    assert scales["network.f.input_high"][0] == pytest.approx(290, abs=1)


@pytest.mark.parametrize(
    ("before", "after", "solved"),
    [
        ("", "", (False, True)),
        ("f(v)\n", "f(w)\n", (True, False)),
        ("y = f(v)", "y = f(v + w)", (True, True)),
        ("state v", "state v in [0, 9]", (False, False)),
        ("v' = w - v", "v' = f(v) - v", (False, False)),
        ("w' = (u - w)/tau", "w' = (f(v) - w)/tau", (False, False)),
    ],
)
def test_only_what_no_unknown_function_moves_is_solved(before: str, after: str, solved: tuple[bool, ...]) -> None:
    assert tuple(solved_states(model_of(MODEL.replace(before, after)), np.zeros(2, dtype=np.bool_))) == solved


def test_a_solution_by_too_large_a_step_tells_no_size() -> None:
    """Rows every 40 for a time constant of 0.02: the guess stays."""
    t = np.linspace(0.0, 400.0, 11)
    item = trajectory("1", 0.0, t, np.cos(t)[:, None], [], inputs=(Signal(t, np.full(11, 280.0)),))
    model = model_of(MODEL.replace("tau = 0.5 in [0.1, 20]", "tau = 0.02 in [0.01, 20]"))
    context = build_context(model, load_module(model), Trajectories((item,), ("y",)), TrainOptions(), 0)
    found = with_solved_states(context, np.array([0.02]))
    assert found.solved is not None and (found.solved == 0).all()


def test_a_measured_state_may_be_moved_by_an_unknown_function() -> None:
    model = model_of(MODEL.replace("w' = (u - w)/tau", "w' = (f(v) - w)/tau"))
    assert tuple(solved_states(model, np.array([True, False]))) == (False, True)
