"""Starts of new trajectories: the best of what can be, not the nearest to a measured value."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gbspec.analysis.prediction.differences import LONGEST, SHORTEST, suited
from gbspec.analysis.prediction.estimate import Estimator
from gbspec.analysis.prediction.forecast import forecast
from gbspec.arrays import Array
from gbspec.backends import Evaluator, load_module
from gbspec.data import Trajectories, scales_of
from gbspec.runs import Run
from tests.training.conftest import model_of, trajectory

DECAY = "model m\ntime t from 0\nstate x in [0, 20]\nx' = -0.1*x\nobserve x\n"
WAVE = "model m\ntime t from 0\nstate w in [0, 100]\ninitial w learn\nw' = 0\nobserve y = sin(w*t)\n"
GROWTH = "model m\ntime t from 0\nstate x in [0, 4000]\nx' = 4*x*(1 - x/1000)\nobserve x\n"


def estimator(text: str, learned: list[float], values: Array, times: Array, noise: float) -> tuple[Estimator, Array]:
    """The estimator of a run whose training has learned these starts, and what it finds for a trajectory."""
    model = model_of(text)
    item = trajectory("1", 0.0, times, values[:, None], [])
    member = load_module(model)({"constants": np.zeros(0), "initial": np.array(learned)[:, None]})
    scales = scales_of(model, Trajectories((item,), (model.channels[0].name,)))
    found = Estimator(Evaluator(member), model, scales, np.array([noise]), released=True)
    return found, found.start(item).state


def test_one_start_of_the_training_does_not_bind_others_to_their_first_value() -> None:
    times = np.linspace(0, 5, 30)
    values = 12 * np.exp(-0.1 * times)
    values[0] -= 5
    found, start = estimator(DECAY, [0.03], values, times, 0.5)
    assert found.prior.sd[0] == 5, "a quarter of the declared range"
    assert start[0] == pytest.approx(12, abs=0.4)


def test_the_noise_of_a_measured_value_is_that_of_the_prior_around_it() -> None:
    times = np.linspace(0, 5, 30)
    values = 10 * np.exp(-0.1 * times)
    values[0] += 3
    _, start = estimator(DECAY, [10.0, 10.01, 9.99], values, times, 1.0)
    assert start[0] == pytest.approx(10, abs=0.4)


def test_starts_of_the_training_are_among_the_guesses() -> None:
    times = np.linspace(0, 5, 40)
    _, start = estimator(WAVE, [5.0, 37.3, 80.0, 11.0], np.sin(37.25 * times), times, 0.05)
    assert start[0] == pytest.approx(37.25, abs=0.02)


def test_a_start_that_data_determine_far_better_than_its_range_has_its_certainty(write_run: Callable[..., Run]) -> None:
    model, times, noise, first = model_of(GROWTH), np.linspace(0, 3, 31), 20.0, 0.03
    grown = np.exp(-4 * times)
    exact = 1000 / (1 + (1000 / first - 1) * grown)
    values = exact + noise * np.random.default_rng(3).standard_normal(31)
    data = Trajectories((trajectory("1", 0.0, times, values[:, None], []),), ("x",))
    member = load_module(model)({"constants": np.zeros(0), "initial": np.array([[0.01]])})
    run = write_run(model, member)
    run = replace(run, fit=replace(run.fit, noise={"x": noise}))
    (item,) = forecast(run, data, window=31).items
    slope = 1000 * 1000 * grown / first**2 / (1 + (1000 / first - 1) * grown) ** 2
    expected = noise / np.sqrt(np.sum(slope**2))
    assert item.start.state[0] == pytest.approx(first, abs=3 * expected)
    certain = np.sqrt(item.sd[:, 0] ** 2 - noise**2)
    middle = slope > 0.3 * slope.max()
    np.testing.assert_allclose(certain[middle], (slope * expected)[middle], rtol=0.2)


def test_steps_change_residuals_by_a_small_part_of_themselves() -> None:
    assert suited(1e-3, 0.02, 1.0) == pytest.approx(5e-4)
    assert suited(1e-3, 0.02, 0.0) == pytest.approx(5e-6), "residuals of almost exact data count as a hundredth"
    assert suited(1e-3, 1e9, 1.0) == SHORTEST
    assert suited(1e-3, 1e-9, 1.0) == suited(1e-3, 0.0, 1.0) == LONGEST
    assert suited(1e-3, float("nan"), 1.0) == suited(1e-3, float("inf"), 1.0) == 1e-5


@pytest.mark.parametrize(
    ("start", "used", "said"),
    [("initial x = 10\n", 0, "1 trajectory: the initial state is given by the model"),
     ("", 1, "1 trajectory: the initial state is given by the first row and the model")],
)  # fmt: skip
def test_a_first_row_that_gives_no_start_is_not_used(
    write_run: Callable[..., Run], start: str, used: int, said: str
) -> None:
    """Its value is compared with the prediction like all others."""
    model, times = model_of(DECAY + start), np.linspace(0, 5, 10)
    run = write_run(model, load_module(model)({"constants": np.zeros(0), "initial": np.full((1, 1), 10.0)}))
    data = Trajectories((trajectory("new", 0.0, times, 10 * np.exp(-0.1 * times)[:, None], []),), ("x",))
    found = forecast(run, data)
    (item,) = found.items
    assert item.used == ("window",) * used + ("predicted",) * (10 - used)
    assert found.errors()["x"].n == 10 - used
    assert said in str(found).split("\n")
    again = [text for text in forecast(run, data, window=3).warnings if "has no effect" in text]
    assert [text.endswith("(`new`): the model gives its start") for text in again] == ([True] if start else [])
