"""Moments through nonlinear functions by sigma points, with exact derivatives in the moments and the parameters.

A normal distribution with mean m and covariance P = L L' stands for the points m and m +- c l_j, with l_j the columns
of L and c^2 = max(3, n) for n coordinates; the points apart from m have the weight 1 / (2 c^2) each (Julier and Uhlmann
1997 with kappa = 3 - n, for n > 3 the cubature rule of Arasaratnam and Haykin 2009: no weight is negative). The values
y_i of a function at these points give its mean, the matrix A of the linear function that fits it best (statistical
linearisation), and the covariance R of what remains,

    E y = sum of w_i y_i,    A L = sum of w_i y_i xi_i',
    R = sum of w_i e_i e_i' - (E e)(E e)',    e = y - y_0 - A (x - m),

so that A P A' + R is the covariance of the values. Functions that are linear have their own matrix, and R = 0.

Where a function has no value at a point (the logarithm of a concentration far below its mean), the points of that
distribution are moved towards the mean by the factor `NARROW`, and mean and covariance are scaled back (Julier 2002):
that is a linearisation at the mean with the second-order term of the mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.local import Arrays
from gbspec.training.problem import Integers

NARROW = 0.01
"""The factor of the distances of points where the function has no value further out."""
LEAST = 1e-9
"""The least variance of points, in squares of the typical sizes of coordinates: what is known exactly needs points too,
and the root of a variance has no derivative at zero."""


@dataclass(frozen=True)
class Varied:
    """Matrices [B, i, j], and where wanted their derivatives [B, p, i, j] in p variables."""

    value: Array
    slopes: Array | None = None

    def __matmul__(self, other: Varied | Array) -> Varied:
        if not isinstance(other, Varied):
            return Varied(_product(self.value, other), None if self.slopes is None else _product(self.slopes, other))
        value, slopes = self.value @ other.value, None
        if self.slopes is not None:
            slopes = each_times(self.slopes, other.value)
        if other.slopes is not None:
            more = self.value[:, None] @ other.slopes
            slopes = more if slopes is None else slopes + more
        return Varied(value, slopes)

    def __add__(self, other: Varied | Array) -> Varied:
        if not isinstance(other, Varied):
            return Varied(self.value + other, self.slopes)
        if self.slopes is None or other.slopes is None:
            return Varied(self.value + other.value, other.slopes if self.slopes is None else self.slopes)
        return Varied(self.value + other.value, self.slopes + other.slopes)

    def __sub__(self, other: Varied) -> Varied:
        return self + other.times(-1.0)

    def times(self, factor: Array | float) -> Varied:
        """Multiplied by a number, or by one for each matrix [B]."""
        if isinstance(factor, np.ndarray):
            factor = factor[:, None, None]
            return Varied(self.value * factor, None if self.slopes is None else self.slopes * factor[:, None])
        return Varied(self.value * factor, None if self.slopes is None else self.slopes * factor)

    @property
    def transposed(self) -> Varied:
        """The transposed matrices."""
        return Varied(self.value.swapaxes(-1, -2), None if self.slopes is None else self.slopes.swapaxes(-1, -2))

    def of(self, who: Integers) -> Varied:
        """Some of the matrices."""
        return Varied(self.value[who], None if self.slopes is None else self.slopes[who])

    @property
    def own(self) -> Varied:
        """A copy, which `put` may change."""
        return Varied(self.value.copy(), None if self.slopes is None else self.slopes.copy())

    def put(self, who: Integers, other: Varied) -> None:
        """Replaces some of the matrices, in place."""
        self.value[who] = other.value
        if self.slopes is not None and other.slopes is not None:
            self.slopes[who] = other.slopes

    @property
    def diagonal(self) -> Varied:
        """Diagonal matrices from columns [B, i, 1]."""
        one = np.eye(self.value.shape[1])
        return Varied(self.value * one, None if self.slopes is None else self.slopes * one)

    @property
    def inverse(self) -> Varied:
        """The inverse matrices; not finite where there is none."""
        value = np.empty_like(self.value)
        try:
            value[:] = np.linalg.inv(self.value)
        except np.linalg.LinAlgError:
            value[:] = np.nan
            good = np.isfinite(self.value).all(axis=(1, 2)) & (np.abs(np.linalg.det(self.value)) > 0)
            value[good] = np.linalg.inv(self.value[good])
        slopes = None if self.slopes is None else -each_times(value[:, None] @ self.slopes, value)
        return Varied(value, slopes)


def _product(left: Array, right: Array) -> Array:
    """Matrices [..., i, j] times one matrix [j, k], as one product, which is faster than many small ones."""
    return (left.reshape(-1, left.shape[-1]) @ right).reshape(*left.shape[:-1], -1)


def each_times(left: Array, right: Array) -> Array:
    """Matrices [B, p, i, j] times [B, j, k], as one product for each of B where they lie in a row: much faster than p
    small ones."""
    if not left.flags.c_contiguous:
        return np.asarray(left @ right[:, None])
    count, p, i, j = left.shape
    return np.asarray(left.reshape(count, p * i, j) @ right).reshape(count, p, i, right.shape[-1])


def root(p: Varied, least: Array) -> Varied:
    """The lower triangular roots (Cholesky) of covariances [B, n, n] with the variances `least` [n] added."""
    n = p.value.shape[-1]
    a, lower = p.value + np.diag(least), np.zeros_like(p.value)
    with np.errstate(all="ignore"):
        for j in range(n):
            rest = a[:, j:, j] - np.einsum("bik,bk->bi", lower[:, j:, :j], lower[:, j, :j])
            pivot = np.sqrt(np.maximum(rest[:, 0], 0.1 * least[j]))
            lower[:, j, j] = pivot
            lower[:, j + 1 :, j] = rest[:, 1:] / pivot[:, None]
        if p.slopes is None:
            return Varied(lower)
        inverse = Varied(lower).inverse.value
        inner = each_times(inverse[:, None] @ p.slopes, inverse.swapaxes(-1, -2))
        half = np.tril(inner) - 0.5 * inner * np.eye(n)
        return Varied(lower, lower[:, None] @ half)


@dataclass(frozen=True)
class _Rule:
    """S points xi [S, n] of the normal distribution, their weights, and matrices that act on values [.., S] there:
    `ray` [S, n] gives sum of w_i y_i xi_i', `rest` [S, S] what is left of a linear function through the mean, and
    `spread` [S, S] the covariance of what is left."""

    points: Array
    weights: Array
    ray: Array
    rest: Array
    spread: Array


@cache
def rule(n: int) -> _Rule:
    """The points of n coordinates."""
    square = float(max(3, n))
    points = np.sqrt(square) * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
    weights = np.concatenate([[1 - n / square], np.full(2 * n, 0.5 / square)])
    ray = weights[:, None] * points
    rest = np.eye(len(points)) - ray @ points.T
    rest[0] -= 1.0
    return _Rule(points, weights, ray, rest, np.diag(weights) - np.outer(weights, weights))


@dataclass(frozen=True)
class Cloud:
    """The points [B, n, S] of B distributions with the roots `lower` of their covariances; `reach` [B] is the factor of
    their distances."""

    at: Varied
    lower: Varied
    reach: Array

    @classmethod
    def of(cls, mean: Varied, lower: Varied, reach: Array) -> Cloud:
        """The points around means [B, n, 1]."""
        points = rule(mean.value.shape[1]).points
        away = (lower @ points.T).times(reach)
        around = mean @ np.ones((1, len(points)))
        return cls(around + away, lower, reach)

    def of_values(self, parts: Arrays, by_state: Arrays, by_rest: Arrays) -> list[Varied]:
        """Values [B, m, S] of functions at the points, from tables with a row for each point [B S, m] and their
        derivatives in the coordinates [B S, m, n] and in the variables after the moments [B S, m, k]."""
        count, n, points = self.at.value.shape
        out = []
        for place, part in enumerate(parts):
            value = part.reshape(count, points, -1).swapaxes(1, 2)
            if not by_state or self.at.slopes is None:
                out.append(Varied(value))
                continue
            m, rest = value.shape[1], by_rest[place]
            moved = np.moveaxis(self.at.slopes, (1, 3), (3, 1))  # [B, S, n, p]
            slopes = by_state[place].reshape(count, points, m, n) @ moved
            slopes[..., slopes.shape[-1] - rest.shape[-1] :] += rest.reshape(count, points, m, -1)
            out.append(Varied(value, np.moveaxis(slopes, (1, 3), (3, 1))))
        return out

    def mean(self, y: Varied) -> Varied:
        """The mean [B, m, 1] of values [B, m, S]."""
        here = rule(self.lower.value.shape[1])
        first = np.eye(len(here.weights))[:, :1]
        return y @ first + (y @ here.rest @ here.weights[:, None]).times(self.reach**-2)

    def average(self, y: Varied) -> Varied:
        """The weighted average [B, m, 1] of values that must not become negative."""
        return y @ rule(self.lower.value.shape[1]).weights[:, None]

    def matrix(self, y: Varied) -> Varied:
        """The matrix A [B, m, n] of the linear function that fits values [B, m, S] best."""
        return (y @ rule(self.lower.value.shape[1]).ray).times(1 / self.reach) @ self._inverse

    @cached_property
    def _inverse(self) -> Varied:
        return self.lower.inverse

    def remaining(self, y: Varied) -> Varied:
        """The covariance R [B, m, m] of what the linear function leaves of values [B, m, S]."""
        here = rule(self.lower.value.shape[1])
        left = y @ here.rest
        return (left @ here.spread @ left.transposed).times(self.reach**-2)


@dataclass(frozen=True)
class Rates:
    """Expectations over distributions: of the drift [B, n, 1], and of the squares of the disturbances [B, n, 1]; the
    `matrix` [B, n, n] is that of the linear function that fits the drift best."""

    drift: Varied
    matrix: Varied
    square: Varied


Stage = Callable[[Fraction, Varied, Varied], Rates]
"""Expectations at a share of the step over distributions with these means and covariances."""


def seeds(mean: Array, cov: Array, width: int, derivatives: bool) -> tuple[Varied, Varied]:
    """Means [B, n, 1] and covariances as variables, before `width` others."""
    (count, n), column = mean.shape, mean[:, :, None]
    if not derivatives:
        return Varied(column), Varied(cov)
    p = n + n * n + width
    d_mean, d_cov = np.zeros((p, n, 1)), np.zeros((p, n, n))
    d_mean[np.arange(n), np.arange(n), 0] = 1.0
    i, j = np.divmod(np.arange(n * n), n)
    # Covariances are symmetrical: each entry stands for half of itself and of its mirror image.
    d_cov[n + np.arange(n * n), i, j] += 0.5
    d_cov[n + np.arange(n * n), j, i] += 0.5
    shape = (count, p)
    return Varied(column, np.broadcast_to(d_mean, (*shape, n, 1))), Varied(cov, np.broadcast_to(d_cov, (*shape, n, n)))
