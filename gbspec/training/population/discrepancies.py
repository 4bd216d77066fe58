"""Normalised prediction distribution errors: where measured values lie among simulated ones.

For each trajectory the values y [n] and K simulated sets of values of the same design are decorrelated by the mean and
the Cholesky factor of the simulated ones, y* = L^-1 (y - E). The part of simulated y* below the measured one has a
uniform distribution if the model is right, and its normal quantile a standard normal one (Brendel, Comets, Laffont,
Laveille and Mentre, Pharm. Res. 23, 2006, 2036; Comets, Brendel and Mentre, Comput. Methods Programs Biomed. 90, 2008,
154). Nothing is linearised. Their mean is tested against 0 (Student), their variance against 1 (chi-squared) and their
form against the normal one (Shapiro and Wilk); of the three p values three times the least is kept (Bonferroni).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, ndtri

from gbspec.arrays import Array, Mask
from gbspec.training.problem import Integers

LEAST = 3
"""At least so many simulated sets for each value of a trajectory: their covariance is estimated from them."""

BLOWN_UP = 1e6
"""A simulated value so many median deviations from the median belongs to a solution that blows up: fixed steps give it
a size of its own, as 1e200, which no covariance survives."""

MANY = 5000
"""Beyond so many values the test of the form is that of D'Agostino and Pearson."""


@dataclass(frozen=True)
class Tested:
    """Mean and variance of `n` prediction errors, and the p value of their being standard normal."""

    n: int
    mean: float
    variance: float
    p: float


def examined(errors: Array) -> Tested | None:
    """The tests of errors, NaN left out; None for fewer than eight."""
    from scipy.stats import normaltest, shapiro, ttest_1samp  # not at the top: every process of a fit would import it

    known = errors[np.isfinite(errors)]
    n = len(known)
    if n < 8 or np.ptp(known) == 0:
        return None
    variance = float(known.var(ddof=1))
    lower = float(chdtr(n - 1, (n - 1) * variance))
    form = normaltest(known).pvalue if n > MANY else shapiro(known).pvalue
    least = min(float(ttest_1samp(known, 0.0).pvalue), 2 * min(lower, 1 - lower), float(form))
    return Tested(n, float(known.mean()), variance, min(1.0, 3 * least))


def prediction_errors(owner: Integers, value: Array, simulated: Array, known: Mask) -> Array:
    """The errors [m] of values [m], given simulated ones [K, m]; NaN where a value is not `known` (a limit), and for
    trajectories whose simulated values are too few or do not vary."""
    out = np.full(len(value), np.nan)
    usable = np.flatnonzero(known)
    order = usable[np.argsort(owner[usable], kind="stable")]
    for rows in np.split(order, np.flatnonzero(np.diff(owner[order])) + 1):
        if len(rows):
            out[rows] = _of_one(value[rows], simulated[:, rows])
    return out


def _of_one(value: Array, simulated: Array) -> Array:
    """The errors [n] of the values of one trajectory."""
    found = _solved(simulated[np.isfinite(simulated).all(axis=1)])
    if len(found) < max(LEAST * len(value), 20):
        return np.full(len(value), np.nan)
    mean = found.mean(axis=0)
    try:
        factor = np.linalg.cholesky(np.atleast_2d(np.cov(found, rowvar=False)))
    except np.linalg.LinAlgError:
        return np.full(len(value), np.nan)
    own = np.linalg.solve(factor, value - mean)
    others = np.linalg.solve(factor, (found - mean).T)
    # Of equal values, as single counts may be, half lie below.
    below = (others < own[:, None]).mean(axis=1) + (others == own[:, None]).mean(axis=1) / 2
    edge = 1 / (2 * len(found))
    return np.asarray(ndtri(np.clip(below, edge, 1 - edge)), dtype=np.float64)


def _solved(found: Array) -> Array:
    """The simulated sets [K, n] without those of solutions that blow up."""
    if not len(found):
        return found
    away = np.abs(found - np.median(found, axis=0))
    size = np.median(away, axis=0)
    return found[(away <= np.where(size > 0, BLOWN_UP * size, np.inf)).all(axis=1)]
