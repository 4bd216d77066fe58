"""Whether residuals follow one another: what a model cannot explain, rather than the noise of measurements."""

from __future__ import annotations

import math

import numpy as np

from gbspec.arrays import Array
from gbspec.training.problem import Problem


def successive(residuals: Array, problem: Problem, channel: int) -> tuple[float | None, int]:
    """The correlation of a channel's residuals [R, C] with the next ones of the same trajectory, and the number of
    pairs; None where it is not defined."""
    packed = problem.packed
    order = np.lexsort((packed.row_index, packed.row_trajectory))
    order = order[problem.seen[order, channel]]
    ours, owner = residuals[order, channel], packed.row_trajectory[order]
    same = owner[1:] == owner[:-1]
    pairs = int(same.sum())
    with np.errstate(over="ignore", invalid="ignore"):
        square = float(np.mean(ours**2)) if len(ours) else 0.0
        product = float(np.sum((ours[1:] * ours[:-1])[same]))
    if not pairs or not math.isfinite(square) or not square > 0:
        return None, pairs
    return product / pairs / square, pairs
