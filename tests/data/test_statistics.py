"""Location and scale of channels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gbspec.data import far_outside
from gbspec.data.statistics import channel_statistics, evenly_spaced, measured_scale
from gbspec.data.trajectories import Trajectories, Trajectory
from tests.texts import model_of


def data(*columns: list[float]) -> Trajectories:
    values = np.array(columns).T
    item = Trajectory("1", 0.0, np.arange(float(len(values))), values, values, values, np.zeros(0))
    return Trajectories((item,), tuple(f"c{i}" for i in range(values.shape[1])))


def test_statistics_of_what_was_measured() -> None:
    nan = math.nan
    first, second = channel_statistics(data([1, 2, 3, nan, 100], [5, nan, 5, 5, 5]))
    assert (first.n, first.mean, first.median, first.low, first.high) == (4, 26.5, 2.5, 1, 100)
    assert first.sd == pytest.approx(np.std([1, 2, 3, 100]))
    assert first.robust_sd == pytest.approx(1.4826 * np.median([1.5, 0.5, 0.5, 97.5]))
    assert (second.n, second.sd, second.scale) == (4, 0.0, 5.0)


def test_a_scale_is_always_positive() -> None:
    nan = math.nan
    never, zero = channel_statistics(data([nan, nan], [0.0, 0.0]))
    assert never.n == 0 and math.isnan(never.mean) and never.scale == 1.0
    assert zero.scale == 1.0
    assert channel_statistics(Trajectories((), ("a",)))[0].scale == 1.0


def test_the_robust_scale_of_normal_values_is_their_standard_deviation() -> None:
    values = np.random.default_rng(0).normal(3.0, 2.0, 20_000)
    (found,) = channel_statistics(data(values.tolist()))
    assert found.robust_sd == pytest.approx(2.0, rel=0.03) and found.sd == pytest.approx(2.0, rel=0.03)


def test_the_scale_falls_back_to_the_size_of_the_values() -> None:
    assert measured_scale(np.array([np.nan, 3.0, 3.0])) == 3.0
    assert measured_scale(np.zeros(3)) == 1.0
    assert measured_scale(np.full(2, np.nan)) == 1.0
    assert measured_scale(np.array([1.0, 3.0])) == 1.0


def test_evenly_spaced_positions_reach_from_the_first_to_the_last() -> None:
    assert evenly_spaced(0, 3) == []
    assert evenly_spaced(2, 3) == [0, 1]
    assert evenly_spaced(9, 3) == [0, 4, 8]
    assert evenly_spaced(9, 1) == [0]


def test_values_far_outside_of_a_range_are_told() -> None:
    """Not those by less than a tenth of the range, as noise makes them."""
    model = model_of("model m\nstate x in [0, 1]\nstate y\nx' = -x\ny' = -y\nobserve x\nobserve y\n")
    assert far_outside(model, np.array([[0.5, 9.0], [1.05, 0.0], [np.nan, 1.0]])) == []
    (told,) = far_outside(model, np.array([[0.5, 9.0], [-1936.0, 0.0], [np.nan, 1.0]]))
    assert told == "`x`: 1 of 2 values lies far outside of its range [0, 1]: -1936"
