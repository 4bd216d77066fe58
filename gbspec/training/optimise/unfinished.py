"""A stage of a likelihood that ended before its maximum: at its most iterations, or where no step leads higher.

How far the maximum may be is what the next step promises: half the product of the gradient and the undamped step, in
-2 log L the square of that step's length in standard deviations.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.diagnostics import ComputationError

PROMISED = 0.1
"""A fall of -2 log L that is worth a remark: a constant a third of its standard deviation from where it should be."""
LEAST = 1e-8
"""The least curvature of an entry, over that of the largest, in the steps of a matrix that is numerically singular."""


def promised_fall(gradient: Array, curvature: Array, moving: Mask) -> float:
    """The fall of an objective that the undamped step of the entries `moving` promises, with its gradient [size] and
    curvature [size, size] there; infinite where they are not finite."""
    slope, matrix = gradient[moving], curvature[np.ix_(moving, moving)]
    if not len(slope):
        return 0.0
    if not (np.isfinite(slope).all() and np.isfinite(matrix).all()):
        return float("inf")
    diagonal = np.maximum(np.diag(matrix), LEAST * max(float(np.diag(matrix).max()), 1e-300))
    scale = 1 / np.sqrt(diagonal)
    scaled = matrix * np.outer(scale, scale) + LEAST * np.eye(len(slope))
    return 0.5 * float(slope * scale @ np.linalg.solve(scaled, slope * scale))


def not_at_maximum(fall: float, iterations: int, stuck: bool) -> ComputationError | None:
    """What is to be said of a stage that ended `stuck`, or at its most `iterations`, where the next step promises
    this fall of -2 log L; None where that is too small to matter."""
    if not fall > PROMISED:
        return None
    if stuck:
        return ComputationError(
            f"in iteration {iterations} no step lowers -2 log likelihood, although its derivatives promise a fall of "
            f"{fall:.2g}, as where it is not smooth",
            remedy="a smaller `--max-step`, other starts, or narrower bounds",
        )
    return ComputationError(
        f"-2 log likelihood is still falling in iteration {iterations}, the last one; the next step promises "
        f"{fall:.2g} less",
        remedy="more iterations (`--effort high`), narrower bounds, or starts nearer to what is meant",
    )
