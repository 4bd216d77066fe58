"""Residuals that are correlated with the next ones: how many of them count, and by how much intervals are wider."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.data.trajectories import Trajectories
from gbspec.runs import (
    ChannelRecord,
)
from gbspec.training import TrainOptions, train
from gbspec.training.problem import autocorrelation_of, in_time, share_that_counts
from gbspec.training.profile.likelihood import profile_constant
from gbspec.training.runs.verdict import (
    autocorrelations,
    widening,
)
from tests.training.conftest import URP, model_of, problem_of, trajectory, urp_data

pytestmark = pytest.mark.usefixtures("quick_fits")


@pytest.mark.parametrize(
    ("correlation", "pairs", "r2", "said"),
    [
        (0.99, 1000, 0.99, "13 times as wide"),
        (0.6, 1000, 0.9, "2 times as wide"),
        (0.4, 1000, 0.9, ""),
        (0.7, 20, 0.9, "2.2 times as wide"),
        (0.5, 20, 0.9, ""),
        (0.48, 25, 0.9, "1.6 times as wide"),
        (0.99, 1000, 1 - 1e-8, ""),
        (None, 0, 0.9, ""),
    ],
)
def test_residuals_that_follow_one_another_are_told(
    correlation: float | None, pairs: int, r2: float, said: str
) -> None:
    found = autocorrelations({"x": ChannelRecord(r2, 0.0, autocorrelation=correlation, pairs=pairs)})
    assert len(found) == bool(said)
    assert all(said in text and "`x`" in text for text in found)


def test_intervals_are_widened_wherever_a_correlation_is_beyond_chance() -> None:
    channels = {"x": ChannelRecord(0.9, 0.0, autocorrelation=0.3, pairs=1000)}
    assert not autocorrelations(channels), "too little to be told"
    assert widening(channels) == pytest.approx((1.3 / 0.7) ** 0.5, rel=1e-3)
    assert widening({"x": ChannelRecord(0.9, 0.0, autocorrelation=0.3, pairs=50)}) == 1.0


def test_channels_weighed_by_what_counts_are_not_widened_again() -> None:
    weighed = ChannelRecord(0.9, 0.0, share=0.05, autocorrelation=0.9, pairs=100)
    plain = ChannelRecord(0.9, 0.0, share=1.0, autocorrelation=0.6, pairs=1000)
    assert widening({"x": weighed}) == 1.0
    (said,) = autocorrelations({"x": weighed})
    assert "weights" in said and "times as wide" not in said
    assert widening({"x": weighed, "y": plain}) == pytest.approx(2.0, rel=1e-3)
    (said,) = autocorrelations({"x": weighed, "y": plain})
    assert "2 times as wide" in said


FALL = """model fall
time t from 0
state x in [0, 2] = 1
learn k = 0.5 in [0.1, 3]
x' = -k*x
initial x = 1
observe x
"""


def test_intervals_of_disturbed_data_are_wider(tmp_path: Path) -> None:
    rng, times = np.random.default_rng(3), np.linspace(0.02, 3, 150)
    noise = 0.02 * rng.standard_normal((2, 150))
    for i in range(1, 150):
        noise[1, i] = 0.9 * noise[1, i - 1] + np.sqrt(1 - 0.9**2) * noise[1, i]
    widths = []
    for number, each in enumerate(noise):
        data = Trajectories((trajectory("1", 0.0, times, (np.exp(-times) + each)[:, None], []),), ("x",))
        run = train(model_of(FALL), data, TrainOptions(effort="low", max_step=0.1), tmp_path / str(number))
        low, high = run.fit.constants["k"].interval or (np.nan, np.nan)
        widths.append(high - low)
        channels = run.fit.members[0].channels or {}
        assert any("autocorrelated" in warning for warning in run.fit.warnings) == (number == 1)
        assert (widening(channels) > 2) == (number == 1)
        covariance = run.certainties().covariance
        assert covariance is not None
        (sd,) = covariance.deviations(np.zeros((1, 0)), np.ones((1, 1)))
        assert (high - low) / 2 == pytest.approx(1.645 * sd, rel=0.25)
        found = profile_constant(run, "k", data, points=3, iterations=20)
        assert found.comparison.trust == "both", "the profile takes the correlation into account too"
        assert (found.low, found.high) == pytest.approx((low, high), abs=0.1 * (high - low))
        assert any("autocorrelated" in note for note in found.notes) == (number == 1)
    assert widths[1] > 2 * widths[0]


def test_successive_residuals_are_those_of_one_trajectory() -> None:
    problem, _, _ = problem_of(model_of(URP), urp_data(3, 2.0, 6), 0.2)
    rng, rows = np.random.default_rng(0), in_time(problem, 0)
    owner = problem.packed.row_trajectory[rows]
    assert (np.diff(problem.packed.row_time[rows])[owner[1:] == owner[:-1]] > 0).all()
    assert len(rows) == int(problem.seen[:, 0].sum())
    white = rng.standard_normal(len(rows))
    found, pairs = autocorrelation_of(white, owner)
    assert found is not None and abs(found) < 4 / np.sqrt(pairs)
    assert pairs == len(rows) - 3
    level = rng.standard_normal(3)[owner]  # the same within a trajectory, unrelated between them
    assert autocorrelation_of(level, owner)[0] == pytest.approx(1.0)
    assert autocorrelation_of(0 * white, owner) == (None, pairs)
    assert autocorrelation_of(np.full(len(rows), np.inf), owner) == (None, pairs)


def test_trajectories_of_one_row_have_no_autocorrelation() -> None:
    residuals, owner = np.array([*np.zeros(10), 1.0, 1.0]), np.array([*range(10), 10, 10])
    found, pairs = autocorrelation_of(residuals, owner)
    assert (found, pairs) == (pytest.approx(1.0), 1)
    channels = {"x": ChannelRecord(0.9, 0.0, autocorrelation=found, pairs=pairs)}
    assert widening(channels) == 1.0 and not autocorrelations(channels), "one pair shows nothing"


def test_intervals_become_no_narrower() -> None:
    shares = [share_that_counts(r, n) for r in (-1.0, -0.3, 0.0, 0.5, 0.99, 1.0, 6.0) for n in (0, 1, 2, 2.5, 1000)]
    assert all(0 < share <= 1 for share in shares)
    assert share_that_counts(0.5, 1e6) == pytest.approx(1 / 3, rel=1e-5)


@pytest.mark.parametrize("r", [0.2, 0.9, 0.99, 0.9999, 1 - 1e-9])
@pytest.mark.parametrize("n", [2, 7, 36])
def test_of_short_trajectories_as_many_count_as_their_mean_tells(r: float, n: int) -> None:
    """Eight of 36 rows with the correlation 0.99 were taken for 1.4 values: no fewer than eight are independent."""
    covariance = r ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    assert share_that_counts(r, n) == pytest.approx(1 / (n * covariance.mean()), rel=1e-4)


def test_intervals_are_widened_by_the_length_of_trajectories() -> None:
    one = ChannelRecord(0.99, 0.0, values=288, autocorrelation=0.99, pairs=280)
    assert widening({"x": one}) == pytest.approx(share_that_counts(0.99, 36) ** -0.5)
    assert 5 < widening({"x": one}) < 6
    assert widening({"x": replace(one, values=None)}) > 10, "older runs do not tell how many trajectories there were"
