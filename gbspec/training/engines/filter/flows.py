"""Moments of nonlinear models over sub-steps, and predictions of rows, by sigma points.

Of a normal x with mean m and covariance P, which the drift f and the disturbances S move,

    dm/dt = E f(x),    dP/dt = F P + P F' + E S S',    F P = E f(x) (x - m)'

(Sarkka 2007, IEEE Trans. Autom. Control 52, 1631; with F = df/dx at m it would be the extended filter). A step of the
model's Runge-Kutta method is taken for m and the transition dA/dt = F A, the expectations at every Runge-Kutta stage by
points of the distribution there, with P = A P A' + (A + 1) t S S' (A + 1)' / 4 after the time t. That at the end is

    P' = A P A' + Q,    Q = integral of A(h, s) S S' A(h, s)' ds,

by Simpson's rule, with A(h, h/2) from the cubic through the values and slopes of A(h, s) at both ends (A and -A F at
the start, 1 and -F at the end). These are sums of squares, and so positive whatever the step. With `rk4` the order is 4
where f is linear, else 3 (2 where the disturbances depend on the state otherwise than in proportion to it).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.ir import Explicit
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.local import Arrays, Evaluated
from gbspec.training.engines.filter.recursion import Flow, Moment, Reading
from gbspec.training.engines.filter.sigma import LEAST, NARROW, Cloud, Varied, root, seeds
from gbspec.training.problem import Integers

HALF = Fraction(1, 2)
Parts = list[Varied]
Values = tuple[Array, Array, Mask]
Function = Callable[[Array, Array, Tensor, Arrays, bool], Evaluated]
"""A function of `Functions`: coordinates, constants, weights, data, and whether derivatives are wanted."""


quiet = np.errstate(all="ignore")
"""Guesses may be far off: what is not finite is marked, and searched on."""


@dataclass(frozen=True)
class Points:
    """The functions of a model at the points of distributions; `scale` [n] are the typical sizes of coordinates,
    `method` that by which steps are taken."""

    functions: Functions
    scale: Array
    method: Explicit

    @quiet
    def stepped(self, at: At, owner: Integers, before: Moment, data: Arrays, derivatives: bool) -> Flow:
        """What happens in sub-steps of the trajectories `owner` [b] from these moments: starts and lengths [b], inputs
        at the method's nodes [b, nodes, inputs], doses at the starts [b, kinds], conditions [b, c]."""
        t, h, u, doses, condition = data
        mean, start = seeds(before.m, before.p, at.layout.width, derivatives)
        cov, one, jump = start, np.eye(len(self.scale)), None
        if doses.shape[-1]:
            cloud, (y,) = self._seen(self.functions.dosed, at, owner, (mean, cov), (doses, condition), derivatives)
            mean, jump, left = cloud.mean(y), cloud.matrix(y), cloud.remaining(y)
            cov = jump @ cov @ jump.transposed + left

        def stage(node: int, m: Varied, p: Varied) -> Parts:
            there = (t + float(nodes[node]) * h, u[:, node], condition)
            cloud, (drift, square) = self._seen(self.functions.field, at, owner, (m, p), there, derivatives)
            return [cloud.mean(drift), cloud.matrix(drift), cloud.average(square).diagonal]

        method, nodes = self.method, self.method.nodes
        found: list[Parts] = []
        rates: list[tuple[Varied, Varied]] = []
        for row, c in zip(method.a[: method.advancing], method.c, strict=False):
            m, a = _ahead(mean, row, rates, h)
            found.append(stage(nodes.index(c), m, _between(a, cov, found[0][2], float(c) * h) if found else cov))
            rates.append((found[-1][0], found[-1][1] @ a))
        m, a = _ahead(mean, method.b[: method.advancing], rates, h)
        last = found[-1]
        if method.c[len(found) - 1] != 1:
            last = stage(len(nodes) - 1, m, _between(a, cov, found[0][2], h))
        halves = [each for each, c in zip(found, method.c, strict=False) if c == HALF]
        middle_square = halves[-1][2] if halves else (found[0][2] + last[2]).times(0.5)
        middle = (a + one).times(0.5) + (last[1] - a @ found[0][1]).times(0.125 * h)
        q = last[2].times(h / 6)
        for factor, square, weight in ((a, found[0][2], 1 / 6), (middle, middle_square, 4 / 6)):
            q = q + factor @ square.times(weight * h) @ factor.transposed
        if jump is not None:
            q, a = q + a @ left @ a.transposed, a @ jump
        tables = before.m, m.value[:, :, 0], a.value, q.value, before.p
        if not derivatives:
            return Flow(*tables)
        end = a @ start @ a.transposed + q
        both, table = len(self.scale) * (len(self.scale) + 1), np.concatenate([_flat(m), _flat(end)], axis=1)
        return Flow(*tables, table[..., :both], table[..., both:])

    @quiet
    def read(self, at: At, owner: Integers, before: Moment, data: Arrays, values: Values, d_r: Array | None) -> Reading:
        """The channels of rows of the trajectories `owner` [b] with these moments; data as for `Local.observation`,
        `values` the measurements with the variances of their noises, of which `d_r` are the derivatives if these are
        wanted, and which were made.

        What the linear functions leave of the channels is added to the variances of their noises.
        """
        mean, cov = seeds(before.m, before.p, at.layout.width, d_r is not None)
        cloud, (y,) = self._seen(self.functions.observation, at, owner, (mean, cov), data, d_r is not None)
        m, c, r = cloud.mean(y), cloud.matrix(y), cloud.remaining(y)
        value, noise, seen = values
        own = np.diagonal(r.value, axis1=1, axis2=2)
        reading = Reading(before.m, m.value[:, :, 0], c.value, value, noise + own, seen, before.p)
        if d_r is None:
            return reading
        count, channels, both = *own.shape, len(self.scale) * (len(self.scale) + 1)
        variance = _flat(r).reshape(count, channels, channels, -1)[:, np.arange(channels), np.arange(channels)]
        table = np.concatenate([_flat(m), _flat(c), variance], axis=1)
        table[:, -channels:, both:] += d_r
        return replace(reading, by_moment=table[..., :both], by_rest=table[..., both:])

    def _seen(
        self,
        function: Function,
        at: At,
        owner: Integers,
        moments: tuple[Varied, Varied],
        data: Arrays,
        derivatives: bool,
    ) -> tuple[Cloud, Parts]:
        """The points of distributions, and the values of a function there; points closer to the mean where there are
        no values."""
        mean, lower = moments[0], root(moments[1], LEAST * self.scale**2)
        reach = np.ones(len(owner))
        for last in (False, True):
            cloud = Cloud.of(mean, lower, reach)
            n, points = cloud.at.value.shape[1:]
            flat = cloud.at.value.swapaxes(1, 2).reshape(-1, n)
            many = np.repeat(owner, points)
            found = function(flat, at.k[many], at.w, tuple(np.repeat(d, points, axis=0) for d in data), derivatives)
            good = [np.isfinite(part.reshape(len(owner), -1)).all(axis=1) for part in found.parts]
            bad = ~np.all(good, axis=0)
            if last or not bad.any():
                break
            reach = np.where(bad, NARROW, 1.0)
        columns = tuple(at.columns(found, many)) if derivatives else ()
        return cloud, cloud.of_values(found.parts, found.by_state, columns)


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


def _flat(table: Varied) -> Array:
    """The derivatives of matrices [b, i, j] as [b, i j, p]."""
    assert table.slopes is not None
    count, p = table.slopes.shape[:2]
    return np.moveaxis(table.slopes.reshape(count, p, -1), 1, -1)
