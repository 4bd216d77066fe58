"""Linear equations with constant factors over a time h, exactly, however fast their modes decay.

With x' = F x + b(t) and independent disturbances whose squares are the diagonal matrix D, F and D constant,

    x(h) = e^{Fh} x(0) + sum of Ji bi  for  b(s) = sum of bi s^i,    Ji = integral of e^{F(h - s)} s^i ds,

and the covariance at the end is e^{Fh} P e^{F'h} + Q, Q = integral of e^{Fs} D e^{F's} ds. They are computed by their
power series for h / 2^j, and doubled j times (e^{Fh} - 1 is doubled, so that no digits are lost). Unlike van Loan's
exponential of one matrix, this has no factor e^{-Fh}, which overflows for fast modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array

SMALL = 0.25
"""Norm of Fh / 2^j at which the series begins."""
TERMS = 16
"""Terms of the series: the first one left out is below 1e-18."""
MOST = 60
"""The most doublings: a norm of 1e17."""


@dataclass(frozen=True)
class Matrices:
    """Matrices [G, n, n] with their derivatives in p variables [G, n, p, n]: in this order their products with matrices
    are products of large matrices, on either side."""

    value: Array
    slopes: Array

    def __matmul__(self, other: Matrices) -> Matrices:
        value = self.value @ other.value
        if not self.slopes.shape[2]:
            return Matrices(value, self.slopes)
        groups, n, p, _ = self.slopes.shape
        slopes = (self.slopes.reshape(groups, n * p, n) @ other.value).reshape(groups, n, p, n)
        slopes += (self.value @ other.slopes.reshape(groups, n, p * n)).reshape(groups, n, p, n)
        return Matrices(value, slopes)

    def __add__(self, other: Matrices) -> Matrices:
        return Matrices(self.value + other.value, self.slopes + other.slopes)

    def times(self, factor: Array | float) -> Matrices:
        """Multiplied by a number, or by one for each matrix [G]."""
        if isinstance(factor, np.ndarray):
            return Matrices(self.value * factor[:, None, None], self.slopes * factor[:, None, None, None])
        return Matrices(self.value * factor, self.slopes * factor)

    @property
    def transposed(self) -> Matrices:
        """The transposed matrices."""
        return Matrices(self.value.swapaxes(1, 2), self.slopes.swapaxes(1, 3))


def propagators(f: Matrices, d: Matrices, h: Array, orders: int) -> list[Matrices]:
    """e^{Fh}, Q, and the first `orders` (at most 3) of J0, J1 and J2, for G lengths `h`."""
    zero = Matrices(np.zeros_like(f.value), np.zeros_like(f.slopes))
    doublings = _needed(f.value, h)
    s = h / 2.0**doublings
    unit = Matrices(zero.value + np.eye(f.value.shape[-1]), zero.slopes)
    e, q, j, power, lie = zero, zero, [zero] * orders, unit, d
    for i in range(TERMS):
        q = q + lie.times(s ** (i + 1) / math.factorial(i + 1))
        for order in range(orders):
            scale = math.factorial(order) / math.factorial(i + order + 1)
            j[order] = j[order] + power.times(scale * s ** (i + order + 1))
        power = f @ power
        e = e + power.times(s ** (i + 1) / math.factorial(i + 1))
        half = f @ lie  # which is symmetrical
        lie = half + half.transposed
    for _ in range(doublings):
        a = unit + e
        q = q + a @ q @ a.transposed
        if orders > 2:
            j[2] = j[2] + a @ j[2] + j[1].times(2 * s) + j[0].times(s**2)
        if orders > 1:
            j[1] = j[1] + a @ j[1] + j[0].times(s)
        j[0] = j[0].times(2.0) + e @ j[0]
        e = e.times(2.0) + e @ e
        s = 2 * s
    return [unit + e, q, *j]


def _needed(f: Array, h: Array) -> int:
    """The number of doublings for these groups; those that are not finite need none."""
    with np.errstate(all="ignore"):
        sizes = np.abs(f).sum(-1).max(-1) * h
    size = float(sizes[np.isfinite(sizes)].max(initial=0.0))
    return min(max(math.ceil(math.log2(size / SMALL)), 0), MOST) if size > 0 else 0
