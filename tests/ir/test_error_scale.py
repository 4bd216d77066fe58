"""The scale on which errors of a channel are judged: of counts against sums over their distributions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import nbinom, poisson

from gbspec.ir import ErrorScale, on_error_scales

MEANS = np.array([0.01, 0.3, 1.0, 3.0, 30.0, 1000.0])


def probabilities(counts: np.ndarray, mean: float, size: float) -> np.ndarray:
    return poisson.pmf(counts, mean) if size == np.inf else nbinom.pmf(counts, size, size / (size + mean))


@pytest.mark.parametrize("size", [np.inf, 5.6, 1.0, 0.2])
def test_a_predicted_count_is_the_expectation_of_the_measured_ones(size: float) -> None:
    scale, counts = ErrorScale(size=size), np.arange(100_000.0)
    expected = [np.sum(scale.measured(counts) * probabilities(counts, mean, size)) for mean in MEANS]
    assert scale.predicted(MEANS) == pytest.approx(expected, abs=5e-3)
    many = np.geomspace(MEANS[0], MEANS[-1], 1001)
    assert scale.predicted(many)[[0, -1]] == pytest.approx([expected[0], expected[-1]], abs=5e-3)


def test_an_average_of_counts_is_compared_as_the_sum() -> None:
    scale, sums = ErrorScale(size=1.5), np.arange(10_000.0)
    expected = np.sum(scale.measured(sums / 4) * probabilities(sums, 4 * 3.0, 4 * 1.5))
    assert scale.predicted(np.array([3.0]), number=4.0) == pytest.approx([expected], abs=5e-3)


@pytest.mark.parametrize(("size", "mean"), [(np.inf, 10.0), (np.inf, 1000.0), (20.0, 10.0), (20.0, 1000.0)])
def test_counts_scatter_by_one(size: float, mean: float) -> None:
    scale, counts = ErrorScale(size=size), np.arange(20_000.0)
    p, values = probabilities(counts, mean, size), scale.measured(counts)
    assert np.sqrt(np.sum(p * values**2) - np.sum(p * values) ** 2) == pytest.approx(1, abs=0.06)


def test_no_count_and_what_is_unknown() -> None:
    scale = ErrorScale(size=3.0)
    assert scale.measured(np.array([0.0])) == pytest.approx([0.0])
    found = scale.predicted(np.array([0.0, -2.0, np.nan, np.inf, 1e300]))
    assert found[:2].tolist() == [0.0, 0.0]
    assert np.isnan(found[2]) and found[3] == np.inf and np.isfinite(found[4])


def test_each_channel_has_its_own_scale() -> None:
    table = np.array([[9.0, 9.0, 9.0], [0.0, 0.0, np.nan]])
    scales = (ErrorScale(), ErrorScale(logarithms=True), ErrorScale(size=np.inf))
    measured, predicted = on_error_scales(scales, table, 1e6 * table)
    assert measured[0] == pytest.approx([9, np.log(9), 6])
    assert predicted[0] == pytest.approx([9e6, np.log(9e6), 6000], rel=1e-3)
    assert measured[1, 0] == 0 and np.isnan(measured[1, 1:]).all()
