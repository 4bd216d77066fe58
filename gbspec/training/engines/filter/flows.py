"""Moments of nonlinear models over sub-steps, and predictions of rows, by sigma points.

Of a normal x with mean m and covariance P, which the drift f and the disturbances S move,

    dm/dt = E f(x),    dP/dt = F P + P F' + E S S',    F P = E f(x) (x - m)'

(Sarkka 2007, IEEE Trans. Autom. Control 52, 1631; with F = df/dx at m it would be the extended filter). A step gives
the mean at its end, and the transition A and the added covariance Q with P' = A P A' + Q, which is positive whatever
the step: `explicit.py` and `frozen.py` take one. A sub-step is one step, or it is divided (`division.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.ir import Explicit, Method
from gbspec.training.engines.filter.division import Tolerance
from gbspec.training.engines.filter.explicit import explicit_step
from gbspec.training.engines.filter.frozen import frozen_step
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.local import Arrays, Evaluated
from gbspec.training.engines.filter.recursion import Flow, Moment, Reading
from gbspec.training.engines.filter.sigma import LEAST, NARROW, Cloud, Rates, Varied, root, seeds
from gbspec.training.problem import Integers

HALF = 0.5
Parts = list[Varied]
Values = tuple[Array, Array, Mask]
Function = Callable[[Array, Array, Tensor, Arrays, bool], Evaluated]
"""A function of `Functions`: coordinates, constants, weights, data, and whether derivatives are wanted."""


quiet = np.errstate(all="ignore")
"""Guesses may be far off: what is not finite is marked, and searched on."""


@dataclass(frozen=True)
class Stepped:
    """Sub-steps of the trajectories `owner` [b] at the values `at`: starts `t` and lengths `h` [b], inputs at the
    method's nodes `u` [b, nodes, inputs], doses at the starts [b, kinds], conditions [b, c]; the `shares` [b, K] of the
    steps in each, in which nothing is left of those that have fewer; and whether derivatives are wanted."""

    at: At
    owner: Integers
    data: Arrays
    shares: Array
    derivatives: bool

    def of(self, who: Integers) -> Stepped:
        """Some of them."""
        return replace(
            self, owner=self.owner[who], data=tuple(part[who] for part in self.data), shares=self.shares[who]
        )


@dataclass
class _Reached:
    """Mean and covariance after some of the steps of sub-steps, and transition and added covariance of these."""

    mean: Varied
    cov: Varied
    a: Array
    q: Array

    def of(self, who: Integers) -> _Reached:
        """Those of some sub-steps."""
        return _Reached(self.mean.of(who), self.cov.of(who), self.a[who], self.q[who])

    def after(self, m: Varied, a: Varied, q: Varied) -> _Reached:
        """What is reached by one more step."""
        cov = a @ self.cov @ a.transposed + q
        return _Reached(m, cov, a.value @ self.a, a.value @ self.q @ a.value.swapaxes(1, 2) + q.value)

    @property
    def own(self) -> _Reached:
        """A copy, which `put` may change."""
        return _Reached(self.mean.own, self.cov.own, self.a.copy(), self.q.copy())

    def put(self, who: Integers, other: _Reached) -> None:
        """What some have reached, in place."""
        self.mean.put(who, other.mean)
        self.cov.put(who, other.cov)
        self.a[who], self.q[who] = other.a, other.q


@dataclass(frozen=True)
class Points:
    """The functions of a model at the points of distributions; `scale` [n] are the typical sizes of coordinates,
    `method` that by which steps are taken."""

    functions: Functions
    scale: Array
    method: Method

    @quiet
    def stepped(self, legs: Stepped, before: Moment) -> Flow:
        """What happens in sub-steps from these moments."""
        reached = self._dosed(legs, before)
        if legs.shares.shape[1] == 1:
            reached = self._step(legs, reached, np.zeros(len(legs.owner)), np.ones(len(legs.owner)))
        else:
            reached = reached.own
            for who, begin, length in _steps(legs.shares):
                reached.put(who, self._step(legs.of(who), reached.of(who), begin, length))
        tables = before.m, reached.mean.value[:, :, 0], reached.a, reached.q, before.p
        if not legs.derivatives:
            return Flow(*tables)
        both = len(self.scale) * (len(self.scale) + 1)
        table = np.concatenate([_flat(reached.mean), _flat(reached.cov)], axis=1)
        return Flow(*tables, table[..., :both], table[..., both:])

    @quiet
    def errors(self, legs: Stepped, before: Moment, tolerance: Tolerance) -> Array:
        """The errors [b, K] of the steps in sub-steps, in units of the tolerance: what two halves of a step change."""
        reached, out = self._dosed(legs, before).own, np.zeros(legs.shares.shape)
        for place, (who, begin, length) in enumerate(_steps(legs.shares)):
            here, twice, count = reached.of(who), np.concatenate([who, who]), len(who)
            lengths = np.concatenate([length, HALF * length])
            both = self._step(legs.of(twice), reached.of(twice), np.concatenate([begin, begin]), lengths)
            whole, middle = both.of(np.arange(count)), both.of(np.arange(count, 2 * count))
            end = self._step(legs.of(who), middle, begin + HALF * length, HALF * length)
            out[who, place] = tolerance.error(
                (here.mean.value[:, :, 0], whole.mean.value[:, :, 0], end.mean.value[:, :, 0]),
                (whole.cov.value, end.cov.value),
            )
            reached.put(who, whole)
        return out

    def _dosed(self, legs: Stepped, before: Moment) -> _Reached:
        """What the doses at the start lead to."""
        doses, condition = legs.data[3:]
        mean, cov = seeds(before.m, before.p, legs.at.layout.width, legs.derivatives)
        count, n = before.m.shape
        unit, zero = np.tile(np.eye(n), (count, 1, 1)), np.zeros((count, n, n))
        start = _Reached(mean, cov, unit, zero)
        if not doses.shape[-1]:
            return start
        cloud, (y,) = self._seen(
            self.functions.dosed, legs.at, legs.owner, (mean, cov), (doses, condition), legs.derivatives
        )
        return start.after(cloud.mean(y), cloud.matrix(y), cloud.remaining(y))

    def _step(self, legs: Stepped, reached: _Reached, begin: Array, length: Array) -> _Reached:
        """One step in sub-steps, after the share `begin` [b] of them, of the share `length` [b]."""
        t, h, u, _, condition = legs.data
        nodes = self.method.nodes

        def stage(node: Fraction, m: Varied, p: Varied) -> Rates:
            share = begin + float(node) * length
            given = u[:, 0] + share[:, None] * (u[:, -1] - u[:, 0])
            if node in nodes:
                given = np.where((length == 1)[:, None], u[:, nodes.index(node)], given)
            data = t + share * h, given, condition
            cloud, (drift, square) = self._seen(
                self.functions.field, legs.at, legs.owner, (m, p), data, legs.derivatives
            )
            return Rates(cloud.mean(drift), cloud.matrix(drift), cloud.average(square))

        if isinstance(self.method, Explicit):
            return reached.after(*explicit_step(self.method, stage, reached.mean, reached.cov, length * h))
        return reached.after(*frozen_step(stage, reached.mean, reached.cov, length * h))

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


def _steps(shares: Array) -> Iterator[tuple[Integers, Array, Array]]:
    """One step of each sub-step that has one, after the other: which sub-steps, and what share of them is before the
    step and what in it."""
    begin = np.concatenate([np.zeros((len(shares), 1)), np.cumsum(shares, axis=1)], axis=1)
    for place in range(shares.shape[1]):
        who = np.flatnonzero(shares[:, place] > 0)
        yield who, begin[who, place], shares[who, place]


def _flat(table: Varied) -> Array:
    """The derivatives of matrices [b, i, j] as [b, i j, p]."""
    assert table.slopes is not None
    count, p = table.slopes.shape[:2]
    return np.moveaxis(table.slopes.reshape(count, p, -1), 1, -1)
