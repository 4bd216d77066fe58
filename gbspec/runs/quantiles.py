"""Half the width of a 90 % interval, in standard deviations, by what the noise is known from."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array

NORMAL_90 = 1.6448536269514722
"""That of a normal distribution, where the noise is known or its uncertainty is part of the likelihood."""


def quantile(freedom: float | None) -> float:
    """The 95 % point of Student's distribution where the noise is estimated from residuals with so many degrees of
    freedom (Student 1908): sqrt(F(1, freedom)) at 90 %. That of the normal distribution where None are known."""
    if freedom is None:
        return NORMAL_90
    from scipy.special import stdtrit  # not every command needs it

    return float(stdtrit(freedom, 0.95))


def spread_of_next(values: Array) -> Array:
    """The standard deviation [...] of the next of N values [N, ...] of a normal distribution of which nothing else is
    known: that of the normal distribution whose 90 % interval is the one of Student's t with N - 1 degrees of freedom,
    s t sqrt(1 + 1/N) (Hahn and Meeker 1991, section 4.7). 0 for a single value."""
    count = len(values)
    if count < 2:
        return np.zeros(values.shape[1:])
    wider = quantile(count - 1) / NORMAL_90 * float(np.sqrt(1 + 1 / count))
    return np.asarray(values.std(axis=0, ddof=1) * wider, dtype=np.float64)
