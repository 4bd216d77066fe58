"""The autocorrelation of residuals, and how many of them count then.

Noise of measurements is independent from row to row; what a model cannot explain is not.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.problem.arrivals import Integers
from gbspec.training.problem.problem import Problem


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


def share_that_counts(correlation: float, pairs: int) -> float:
    """The share of values that count, (1 - r) / (1 + r) with the correlation r of successive ones, which falls
    geometrically; at least one value of all counts, and at most all of them."""
    return float(np.clip((1 - correlation) / (1 + correlation), 1 / (pairs + 1), 1.0)) if correlation > 0 else 1.0
