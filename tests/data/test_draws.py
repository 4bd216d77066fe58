"""Draws of constants over their ranges: quantiles, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gbspec.data.draws import MARGIN, sobol, spread_over_ranges
from gbspec.ir.model import Learnable, Prior, Range


def quantiles(learnable: Learnable, *at: float) -> list[float]:
    """The values of a constant at quantiles."""
    points = (np.array(at)[:, None] - MARGIN) / (1 - 2 * MARGIN)
    return [float(value) for value in spread_over_ranges((learnable,), points)[:, 0]]


def test_one_half_of_a_bounded_range_is_uniform() -> None:
    assert quantiles(Learnable("k", range=Range(-2.0, 6.0)), 0.0, 0.25, 0.49999) == pytest.approx([-2, 2, 6], abs=1e-3)


@pytest.mark.parametrize(("start", "lowest"), [(1.0, 1e-4), (1e-4, 1e-7), (0.0, 1e-14)])
def test_the_other_half_covers_decades_from_the_end_that_is_zero(start: float, lowest: float) -> None:
    # down to a hundredth of the start, if that is less than four decades below the other end
    found = quantiles(Learnable("k", start=start, range=Range(0.0, 10.0)), 0.5, 0.75, 1.0)
    assert found == pytest.approx([10 * lowest, 10 * math.sqrt(lowest), 10.0])
    mirrored = quantiles(Learnable("k", start=-start, range=Range(-10.0, 0.0)), 0.5, 0.75, 1.0)
    assert mirrored == pytest.approx([-10.0, -10 * math.sqrt(lowest), -10 * lowest])


def test_the_other_half_of_a_range_without_zero_is_drawn_around_the_start() -> None:
    found = quantiles(Learnable("k", start=3.0, range=Range(-100.0, 100.0)), 0.625, 0.75, 0.875)
    assert found == pytest.approx([0.0, 3.0, 6.0])


def test_a_range_of_decades_is_logarithmic() -> None:
    assert quantiles(Learnable("k", range=Range(1e-4, 1e4)), 0.25, 0.5) == pytest.approx([1e-2, 1.0])


def test_with_one_bound_draws_are_around_the_distance_of_the_start() -> None:
    low = quantiles(Learnable("k", start=2.0, range=Range(1.0, math.inf)), 0.5, 0.75)
    assert low == pytest.approx([3.0, 1.0 + 2.0 * 10 ** (0.7 * math.log(3))])
    high = quantiles(Learnable("k", start=2.0, range=Range(-math.inf, 5.0)), 0.5, 0.75)
    assert high == pytest.approx([3.0, 5.0 - 2.0 * 10 ** (0.7 * math.log(3))])


def test_a_prior_is_what_is_drawn_from() -> None:
    one_sd = 0.841344746068543
    normal = Learnable("k", prior=Prior("normal", 3.0, 0.5))
    assert quantiles(normal, 0.5, one_sd) == pytest.approx([3.0, 3.5])
    skewed = Learnable("k", prior=Prior("lognormal", 3.0, 0.5))
    assert quantiles(skewed, 0.5, one_sd) == pytest.approx([3.0, 3.0 * math.exp(math.sqrt(math.log(1.25)))])


def test_points_are_evenly_spread_and_follow_the_seed() -> None:
    points = sobol(16, 2, 3)
    assert points.shape == (16, 2) and np.array_equal(points, sobol(16, 2, 3))
    assert not np.array_equal(points, sobol(16, 2, 4))
    for column in points.T:
        assert sorted((column * 16).astype(int)) == list(range(16))
    assert sobol(5, 2, 3).shape == (5, 2) and sobol(5, 0, 3).shape == (5, 0)
