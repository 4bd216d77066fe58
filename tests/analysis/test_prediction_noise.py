"""Intervals of predictions: noise that depends on the value, and estimates that move with what is shared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.prediction.forecast import forecast
from gbspec.data import Trajectories
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = """model decay
time t from 0
state x in [0, 100]
learn k = 0.5 in [0.05, 5]
{more}
x' = -k*x
initial x = {start}
observe x noise {noise}
"""


def decays(starts: list[float], noise: float, seed: int, rates: list[float] | None = None) -> Trajectories:
    """Exponential decays with relative noise."""
    random, times = np.random.default_rng(seed), np.linspace(0.2, 8, 14)
    items = []
    for i, start in enumerate(starts):
        values = start * np.exp(-(rates[i] if rates else 0.6) * times) * np.exp(noise * random.standard_normal(14))
        items.append(trajectory(f"{seed}-{i}", 0.0, times, values[:, None], []))
    return Trajectories(tuple(items), ("x",))


def test_a_noise_that_depends_on_the_value_is_that_of_predictions(tmp_path: Path) -> None:
    more, noise = "learn b = 0.2 in [0.01, 1]", "normal(sqrt(0.01^2 + (b*y)^2))"
    model = model_of(DECAY.format(more=more, start="60", noise=noise))
    run = train(model, decays([60.0] * 4, 0.1, 0), TrainOptions(effort="low"), tmp_path / "run")
    (item,) = forecast(run, decays([60.0], 0.1, 9)).items
    share = item.sd[:, 0] / np.hypot(0.01, item.mean[:, 0])
    assert run.fit.constants["b"].value == pytest.approx(0.1, rel=0.3)
    np.testing.assert_allclose(item.sd[:, 0], np.hypot(0.01, 0.1 * item.mean[:, 0]), rtol=0.3)
    assert share.min() < 0.2


def test_what_a_new_trajectory_has_of_its_own_moves_with_what_is_shared(tmp_path: Path) -> None:
    """Amplitude and gain are known as a product alone: the estimate of one meets a change of the other."""
    text = DECAY.format(
        more="learn a in [1, 100] per trajectory\nlearn g = 1 in [0.2, 5]", start="a", noise="lognormal(0.1)"
    )
    model = model_of(text.replace("observe x", "observe y = g*x"))
    data = decays([20.0, 30.0, 40.0], 0.1, 0)
    data = Trajectories(data.items, ("y",))
    run = train(model, data, TrainOptions(effort="low"), tmp_path / "run")
    new = replace(decays([25.0], 0.1, 5), channels=("y",))
    (item,) = forecast(run, new, window=10).items
    assert np.all(item.sd[:, 0] < 0.25 * item.mean[:, 0])
    assert np.all(item.mean > 0)


def test_predictions_of_a_network_have_as_much_variance_as_the_fit_has_freedom(tmp_path: Path) -> None:
    """Over the rows of the training table, the model's variance in units of the noise's sums up to the degrees of
    freedom (the trace of the hat matrix)."""
    model = model_of(
        "model decay\ntime t from 0\nstate x in [0, 2]\nunknown f(x) >= 0\nx' = -f\ninitial x = 1\nobserve x\n"
    )
    random, times = np.random.default_rng(0), np.linspace(0.2, 3, 15)
    values = [np.exp(-times) + 0.02 * random.standard_normal(15) for _ in range(3)]
    items = [trajectory(str(i), 0.0, times, one[:, None], []) for i, one in enumerate(values)]
    run = train(model, Trajectories(tuple(items), ("x",)), TrainOptions(effort="low", max_step=0.1), tmp_path / "run")
    moved = [replace(item, label=f"new {item.label}", values=item.values + 1e-9) for item in items]
    predicted = forecast(run, Trajectories(tuple(moved), ("x",))).items
    noise, covariance = run.fit.noise["x"], run.certainties().covariance
    assert noise is not None
    assert covariance is not None
    freedom = float(np.sum(1 - covariance.shares))
    total = sum(float(np.sum((item.sd[:, 0] / noise) ** 2 - 1)) for item in predicted)
    assert 0.4 * freedom < total < 2 * freedom


def test_the_noise_of_a_measured_first_value_is_part_of_a_prediction(tmp_path: Path) -> None:
    """The state adds up a known input: an error of its first value stays. Of four replicates it is half as large."""
    text = "model tank\ntime t\nstate x in [-2, 9]\nlearn k = 1 in [0, 5]\nx' = k\nobserve x noise normal(0.1)\n"
    model = model_of(text)
    random, times = np.random.default_rng(3), np.linspace(0, 4, 12)

    def tanks(count: int, label: str) -> Trajectories:
        values = [0.5 * times + 0.1 * random.standard_normal(12) for _ in range(count)]
        items = [trajectory(f"{label}{i}", 0.0, times, one[:, None], []) for i, one in enumerate(values)]
        return Trajectories(tuple(items), ("x",))

    run = train(model, tanks(20, "old"), TrainOptions(effort="low"), tmp_path / "run")
    one = tanks(1, "new")
    replicated = Trajectories((replace(one.items[0], counts=4 * one.items[0].counts),), ("x",))
    for data, first in ((one, 0.1), (replicated, 0.05)):
        (item,) = forecast(run, data).items
        np.testing.assert_allclose(item.sd[:, 0], np.hypot(0.1, first), rtol=0.05)


def test_a_learned_initial_value_is_as_uncertain_as_its_constant(tmp_path: Path) -> None:
    """At the start a prediction is that constant, and its variance that of the noise and of the constant."""
    model = model_of(DECAY.format(more="learn a = 30 in [1, 100]", start="a", noise="normal(4)"))
    item = decays([50.0], 0.1, 3).items[0]
    run = train(model, Trajectories((item,), ("x",)), TrainOptions(effort="low"), tmp_path / "run")
    empty = {"values": np.array([[np.nan]]), "counts": np.zeros((1, 1)), "sd": np.array([[np.nan]])}
    new = Trajectories((replace(item, label="new", times=np.array([1e-6]), **empty),), ("x",))  # type: ignore[arg-type]  # arrays by name
    known = forecast(run, new).items[0].sd[0, 0]
    (tmp_path / "run" / "members" / "0" / "covariance.safetensors").unlink()
    noise = forecast(open_run(tmp_path / "run"), new).items[0].sd[0, 0]
    assert np.sqrt(known**2 - noise**2) == pytest.approx(run.fit.constants["a"].sd, rel=0.5)
