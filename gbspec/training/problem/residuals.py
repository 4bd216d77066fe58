"""The residuals of a problem from an engine's predictions, and losses of residuals.

`gbspec.ir.residual` defines the residual; this module supplies it with the data of a problem.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import ErrorScale, residuals, slopes
from gbspec.training.problem.problem import Problem

OUTLYING, FEW = 4.0, 0.05
"""Residuals beyond `OUTLYING` robust standard deviations are outliers, if they are at most the share `FEW` of all, or a
single one."""


def residuals_of(problem: Problem, predicted: Array) -> Array:
    """Residuals [R, C] of predicted channels [R, C]; 0 where nothing was measured."""
    with np.errstate(over="ignore", invalid="ignore"):  # predictions of a solution that is not finite
        given = problem.measured, problem.factor, problem.scaling.log
        return np.asarray(residuals(predicted, *given, censored=problem.censored, sizes=problem.scaling.sizes))


def judged_residuals(problem: Problem, predicted: Array, scales: Sequence[ErrorScale]) -> Array:
    """The same by which a fit is judged: of counts differences on the scale of their noise (`gbspec.ir.error_scales`),
    since the sum of squares weighs them by the root of the measured count alone."""
    out, packed = residuals_of(problem, predicted), problem.packed
    for i, scale in enumerate(scales):
        seen = problem.valued[:, i]
        if scale.size is not None and seen.any():
            out[seen, i] = scale.errors(packed.values[seen, i], predicted[seen, i], packed.weights[seen, i] ** 2)
    return out


def residual_slopes(problem: Problem, predicted: Array) -> Array:
    """Derivatives of the residuals by the predictions [R, C]; 0 where nothing was measured."""
    given = problem.measured, problem.factor, problem.scaling.log
    return np.asarray(slopes(predicted, *given, censored=problem.censored, sizes=problem.scaling.sizes))


def measured_only(problem: Problem, table: Array) -> Array:
    """The entries of a table [R, C] at measured values [m], row by row."""
    return np.asarray(table[problem.seen], dtype=np.float64)


def mean_loss(residuals: Array) -> float:
    """Mean of half squared residuals; infinite if one is not finite."""
    if not np.isfinite(residuals).all():
        return float("inf")
    with np.errstate(over="ignore"):  # a mean that overflows is infinite too
        return 0.5 * float(np.mean(residuals**2)) if len(residuals) else 0.0


def typical(residuals: Array) -> float:
    """1.4826 times the median absolute residual (the standard deviation if normal); infinite if one is not finite."""
    if not np.isfinite(residuals).all():
        return float("inf")
    return 1.4826 * float(np.median(np.abs(residuals))) if len(residuals) else 0.0


def limited(residuals: Array) -> Array:
    """Absolute residuals, of outliers no more than `OUTLYING` robust standard deviations.

    Where more than a few lie so far out, the residuals are of two kinds, such as those of values that are fitted
    exactly beside others, and the median says nothing of the larger ones: then all count in full. So they do where most
    are zero.
    """
    found, most = np.abs(residuals), OUTLYING * typical(residuals)
    few = most > 0 and np.count_nonzero(found > most) <= max(FEW * len(found), 1)
    return np.asarray(np.minimum(found, most) if few else found, dtype=np.float64)
