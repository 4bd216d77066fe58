"""The autocorrelation of residuals, and how many of them count then.

Noise of measurements is independent from row to row; what a model cannot explain is not.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.problem.arrivals import Integers
from gbspec.training.problem.problem import Problem

NEARLY_ONE = 1e-6
"""A correlation this near to 1, in units of 1 / length, is that of one value."""


def in_time(problem: Problem, channel: int) -> Integers:
    """The rows with a measurement of a channel, in the order of time, trajectory by trajectory."""
    packed, rows = problem.packed, np.flatnonzero(problem.valued[:, channel])
    return np.asarray(rows[np.lexsort((packed.row_index[rows], packed.row_trajectory[rows]))], dtype=np.int64)


def autocorrelation_of(residuals: Array, owner: Integers) -> tuple[float | None, int]:
    """The correlation of residuals [m], in the order of time, with the next ones of the same `owner` [m].

    With the number of pairs; None where it is not defined.

    Their mean is taken to be zero, so that a constant error counts as correlated.
    """
    same = owner[1:] == owner[:-1]
    first, second = residuals[:-1][same], residuals[1:][same]
    with np.errstate(over="ignore", invalid="ignore"):
        size = float(np.sqrt(np.sum(first**2))) * float(np.sqrt(np.sum(second**2)))
        product = float(np.sum(first * second))
    if not size > 0 or not np.isfinite(size):
        return None, len(first)
    return product / size, len(first)


def share_that_counts(correlation: float, length: float) -> float:
    """The share of the values of trajectories with `length` of them on average that count where successive ones have
    the correlation r, which falls geometrically: the variance of the mean of independent values over that of these,
    1 / (1 + 2 sum (1 - k/length) r^k) with k < length (Box, Jenkins and Reinsel, Time Series Analysis, 2008, 2.1).

    It is (1 - r) / (1 + r) of long trajectories, and at least one value of each counts: trajectories are independent.
    """
    r, n = min(correlation, 1.0), max(length, 1.0)
    if r <= 0:
        return 1.0
    if (1 - r) * n < NEARLY_ONE:  # the terms of the other expression cancel
        return 1 / n
    inflation = (1 + r) / (1 - r) - 2 * r * (1 - r**n) / (n * (1 - r) ** 2)
    return float(np.clip(1 / inflation, 1 / n, 1.0))
