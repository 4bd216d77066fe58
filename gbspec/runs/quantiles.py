"""Half the width of a 90 % interval, in standard deviations, by what the noise is known from."""

from __future__ import annotations

NORMAL_90 = 1.6448536269514722
"""That of a normal distribution, where the noise is known or its uncertainty is part of the likelihood."""


def quantile(freedom: float | None) -> float:
    """The 95 % point of Student's distribution where the noise is estimated from residuals with so many degrees of
    freedom (Student 1908): sqrt(F(1, freedom)) at 90 %. That of the normal distribution where None are known."""
    if freedom is None:
        return NORMAL_90
    from scipy.special import stdtrit  # not every command needs it

    return float(stdtrit(freedom, 0.95))
