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

    def plus(self, constant: Array) -> Matrices:
        """With a matrix [n, n] added that does not vary."""
        return Matrices(self.value + constant, self.slopes)

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
    doublings = _needed(f.value, h)
    s = h / 2.0**doublings
    e, q, j = _series(f.times(s), d.times(s), s)
    unit = np.eye(f.value.shape[-1])
    for _ in range(doublings):
        a = e.plus(unit)
        q = q + a @ q @ a.transposed
        if orders > 2:
            j[2] = j[2] + a @ j[2] + j[1].times(2 * s) + j[0].times(s**2)
        if orders > 1:
            j[1] = j[1] + a @ j[1] + j[0].times(s)
        if orders > 0:
            j[0] = j[0].times(2.0) + e @ j[0]
        e = e.times(2.0) + e @ e
        s = 2 * s
    return [e.plus(unit), q, *j[:orders]]


def _series(x: Matrices, d: Matrices, s: Array) -> tuple[Matrices, Matrices, list[Matrices]]:
    """e^{X} - 1, Q, and J0, J1 and J2, from X = F s and D s: with phi_k = sum of X^i / (i + k)!, which is
    1/k! + X phi_(k + 1), they are X phi_1, and phi_1 s, phi_2 s^2 and 2 phi_3 s^3."""
    unit = np.eye(x.value.shape[-1])
    phi, q = Matrices(np.broadcast_to(unit, x.value.shape), np.zeros_like(x.slopes)), d
    for k in range(TERMS, 0, -1):
        phi = (x @ phi).times(1 / (k + 3)).plus(unit)
        half = x @ q  # q is symmetrical
        q = (half + half.transposed).times(1 / (k + 1)) + d
    third = phi.times(1 / 6)
    second = (x @ third).plus(unit / 2)
    first = (x @ second).plus(unit)
    return x @ first, q, [first.times(s), second.times(s**2), third.times(2 * s**3)]


def _needed(f: Array, h: Array) -> int:
    """The number of doublings for these groups; those that are not finite need none."""
    with np.errstate(all="ignore"):
        sizes = np.abs(f).sum(-1).max(-1) * h
    size = float(sizes[np.isfinite(sizes)].max(initial=0.0))
    return min(max(math.ceil(math.log2(size / SMALL)), 0), MOST) if size > 0 else 0
