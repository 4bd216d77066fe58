"""A step of an explicit Runge-Kutta method for mean and covariance.

It is taken for m and the transition dA/dt = F A, the expectations at every Runge-Kutta stage by points of the
distribution there, with P = A P A' + (A + 1) t S S' (A + 1)' / 4 after the time t. That at the end is

    P' = A P A' + Q,    Q = integral of A(h, s) S S' A(h, s)' ds,

by Simpson's rule, with A(h, h/2) from the cubic through the values and slopes of A(h, s) at both ends (A and -A F at
the start, 1 and -F at the end). These are sums of squares, and so positive whatever the step. With `rk4` the order is 4
where f is linear, else 3 (2 where the disturbances depend on the state otherwise than in proportion to it).
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Explicit
from gbspec.training.engines.filter.sigma import Rates, Stage, Varied

HALF, END = Fraction(1, 2), Fraction(1)


def explicit_step(method: Explicit, stage: Stage, mean: Varied, cov: Varied, h: Array) -> tuple[Varied, Varied, Varied]:
    """Mean, transition and added covariance of steps of the lengths `h` [b]."""
    found: list[Rates] = []
    rates: list[tuple[Varied, Varied]] = []
    for row, c in zip(method.a[: method.advancing], method.c, strict=False):
        m, a = _ahead(mean, row, rates, h)
        found.append(stage(c, m, _between(a, cov, found[0].square.diagonal, float(c) * h) if found else cov))
        rates.append((found[-1].drift, found[-1].matrix @ a))
    m, a = _ahead(mean, method.b[: method.advancing], rates, h)
    last, first = found[-1], found[0].square.diagonal
    if method.c[len(found) - 1] != 1:
        last = stage(END, m, _between(a, cov, first, h))
    halves = [each for each, c in zip(found, method.c, strict=False) if c == HALF]
    end = last.square.diagonal
    middle_square = halves[-1].square.diagonal if halves else (first + end).times(0.5)
    middle = (a + np.eye(a.value.shape[1])).times(0.5) + (last.matrix - a @ found[0].matrix).times(0.125 * h)
    q = end.times(h / 6)
    for factor, square, weight in ((a, first, 1 / 6), (middle, middle_square, 4 / 6)):
        q = q + factor @ square.times(weight * h) @ factor.transposed
    return m, a, q


def _ahead(
    start: Varied, row: Sequence[Fraction], rates: Sequence[tuple[Varied, Varied]], h: Array
) -> tuple[Varied, Varied]:
    """Mean and transition after a step with these weights of their rates."""
    count, n = start.value.shape[:2]
    mean, way = start, Varied(np.broadcast_to(np.eye(n), (count, n, n)))
    for weight, (of_mean, of_way) in zip(row, rates, strict=True):
        if weight:
            mean, way = mean + of_mean.times(float(weight) * h), way + of_way.times(float(weight) * h)
    return mean, way


def _between(way: Varied, cov: Varied, square: Varied, time: Array) -> Varied:
    """The covariance after a part of a sub-step, of order 3 in its length, and positive."""
    middle = (way + np.eye(cov.value.shape[1])).times(0.5)
    return way @ cov @ way.transposed + middle @ square.times(time) @ middle.transposed
