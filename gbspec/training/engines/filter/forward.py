"""The functions of `local`, for models without networks, by forward mode in numpy: the same numbers in less time.

`Local` differentiates with torch, which costs a fixed time for each of thousands of small operations; `Forward` is
chosen where it can be, and the tests compare both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.training.engines.filter.coordinates import LEAST
from gbspec.training.engines.filter.jets import Jet, Vector, jet, jet_arithmetic
from gbspec.training.engines.filter.local import Arrays, Evaluated, Local


def covers(model: Model) -> bool:
    """Whether equations need no networks, vectors, tables or searches."""
    return not (model.networks or model.arrays or model.tables or model.algebraics or model.steady or model.delays)


@dataclass(frozen=True)
class _Point:
    """The model at B points: conditions [B, c], and constants [B, k] as jets whose derivatives follow those of `n`
    coordinates; p variables in all."""

    local: Local
    condition: Array
    constants: tuple[Any, ...]
    n: int
    p: int
    bent: bool

    def seeded(self, z: Array) -> Vector:
        """Coordinates [B, n] as variables."""
        unit, n = np.eye(self.p)[:, None], self.n if self.bent else 0
        return Vector(Jet(z[:, i], unit[i], None, n) for i in range(self.n))

    def states(self, z: Vector) -> Vector:
        """The states of coordinates."""
        if self.local.coordinates.plain:
            return z
        exp, log = jet_arithmetic().exp, self.local.coordinates.log
        return Vector(exp(x) if logged else x for x, logged in zip(z, log, strict=True))

    def of_states(self, x: Vector) -> Vector:
        """The coordinates of states."""
        if self.local.coordinates.plain:
            return x
        log, logged = jet_arithmetic().log, self.local.coordinates.log
        return Vector(log(each) if mine else each for each, mine in zip(x, logged, strict=True))

    def spread(self, x: Vector, u: Array) -> Vector:
        """The sizes of the disturbances [n] at states."""
        equations = self.local.problem.module.equations
        found: Vector = equations.diffusions(jet_arithmetic(), x, self.condition, u, self.constants)
        return found

    def drift(self, t: Any, z: Vector, u: Array) -> Vector:
        """The drift of the coordinates [n]."""
        log, x = self.local.coordinates.log, self.states(z)
        equations = self.local.problem.module.equations
        rate: Vector = equations.rhs(jet_arithmetic(), t, x, self.condition, u, self.constants, ())
        if self.local.coordinates.plain:
            return rate
        sizes = self.spread(x, u)
        return Vector(rate[i] / x[i] - 0.5 * (sizes[i] * sizes[i]) if log[i] else rate[i] for i in range(len(rate)))

    def dosed(self, z: Vector, amounts: Array) -> Vector:
        """The coordinates after doses [B, kinds]."""
        model, equations = self.local.problem.model, self.local.problem.module.equations
        parts = list(self.states(z))
        for kind, (fraction, _) in enumerate(equations.doses(jet_arithmetic(), self.condition, self.constants)):
            state = model.state_index[model.doses[kind].state]
            parts[state] = parts[state] + amounts[:, kind] * jet(fraction)
        return self.of_states(Vector(parts))

    def observed(self, t: Array, z: Vector, u: Array) -> Vector:
        """The predicted channels [C]."""
        ops, equations = jet_arithmetic(), self.local.problem.module.equations
        y = equations.observe(ops, t, self.states(z), self.condition, u, self.constants, ())
        return Vector(
            ops.log(ops.where(jet(each).value > LEAST, each, LEAST)) if logged else each
            for each, logged in zip(y, self.local.log_channels, strict=True)
        )


@dataclass(frozen=True)
class Forward:
    """The functions of a problem's sub-steps and rows."""

    local: Local

    def _point(self, k: Array, condition: Array, n: int, derivatives: bool) -> _Point:
        known = tuple(float(constant.value) for constant in self.local.problem.model.constants)
        p = n + (k.shape[1] if derivatives else 0)
        learned: list[Any] = [k[:, i] for i in range(k.shape[1])]
        if derivatives:
            learned = [Jet(value, np.eye(p)[None, n + i], None, n) for i, value in enumerate(learned)]
        return _Point(self.local, condition, (*known, *learned), n, p, derivatives)

    # ---------------------------------------------------------------- sub-steps
    def moved(self, z: Array, k: Array, data: Arrays) -> tuple[Arrays, Array]:
        """`Local.moved`."""
        t, h, u, doses, condition = data
        n = z.shape[1]
        a, q, starts = np.tile(np.eye(n), (len(z), 1, 1)), np.zeros((len(z), n, n)), []
        for s in range(t.shape[1]):
            starts.append(z)
            z, step, more = self._stepped(z, k, (t[:, s], h[:, s], u[:, s], doses[:, s], condition), False).parts
            with np.errstate(all="ignore"):
                a, q = step @ a, step @ q @ step.transpose(0, 2, 1) + more
        return (z, a, q), np.stack(starts, 1)

    def step(self, z: Array, k: Array, data: Arrays) -> Evaluated:
        """`Local.step` with its derivatives."""
        return self._stepped(z, k, data, True)

    def _stepped(self, z: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        t, h, u, doses, condition = data
        with np.errstate(all="ignore"):
            point = self._point(k, condition, z.shape[1], derivatives)
            if not doses.shape[-1]:
                return self._split(*self._undosed(point, z, (t, h, u)), point.n)
            jump = point.dosed(point.seeded(z), doses)
            return _after(jump, self._undosed(point, jump.value(len(z)), (t, h, u)), point)

    def _undosed(self, point: _Point, z: Array, data: Arrays) -> tuple[Arrays, Arrays]:
        """Mean, transition and added covariance of a sub-step, and their derivatives [B, ..., p]."""
        t, h, u = data
        ops, equations = jet_arithmetic(), self.local.problem.module.equations
        nodes, n, p, count = tuple(u[:, i] for i in range(u.shape[1])), z.shape[1], point.p, len(z)
        slopes: list[Vector] = []

        def drift(*at: Any) -> Vector:
            slopes.append(point.drift(*at))
            return slopes[-1]

        # The first one that a step of any explicit method takes is that at its start.
        end = equations.step(ops, drift, equations.grid(ops, t, h), point.seeded(z), nodes)
        mean = end.value(count)
        first, last = slopes[0], point.drift(t + h, point.seeded(mean), nodes[-1])
        d_end = end.slopes(count, p)
        a, f, g = d_end[..., :n], first.slopes(count, p)[..., :n], last.slopes(count, p)[..., :n]
        size = h[:, None, None]
        middle = 0.5 * (a + np.eye(n)) + 0.125 * size * (g - a @ f)
        between = nodes[self.local.middle] if self.local.middle is not None else 0.5 * (nodes[0] + nodes[-1])
        places = (z, nodes[0]), (0.5 * (z + mean), between), (mean, nodes[-1])
        spreads = [point.spread(point.states(point.seeded(where)), inputs) for where, inputs in places]
        factors, sizes = (a, middle, np.eye(n)[None]), [spread.value(count) for spread in spreads]
        x = [m * s[:, None] for m, s in zip(factors, sizes, strict=True)]
        weights = (size / 6, 4 * size / 6, size / 6)
        q = sum(w * (each @ each.transpose(0, 2, 1)) for w, each in zip(weights, x, strict=True))
        if not point.bent:
            return (mean, a, np.asarray(q)), ()
        da, df = end.bends(count, n, p), first.bends(count, n, p)
        dg = _along(last.bends(count, n, p), d_end, n)
        d_middle = 0.5 * da + 0.125 * size[..., None] * (dg - _product(a, f, da, df))
        one = np.broadcast_to(np.eye(n, p), (count, n, p))
        dq = np.zeros((count, n, n, p))
        moves = zip(
            weights, x, factors, (da, d_middle, None), spreads, sizes, (one, 0.5 * (one + d_end), d_end), strict=True
        )
        for w, each, factor, d_factor, spread, s, d_place in moves:
            dx = factor[..., None] * _along(spread.slopes(count, p), d_place, n)[:, None]
            if d_factor is not None:
                dx = dx + d_factor * s[:, None, :, None]
            part = np.matmul(each[:, None], dx)
            dq += w[..., None] * (part + part.transpose(0, 2, 1, 3))
        return (mean, a, np.asarray(q)), (d_end, da, dq)

    @staticmethod
    def _split(parts: Arrays, slopes: Arrays, n: int) -> Evaluated:
        """Derivatives by coordinates and by constants."""
        none = tuple(np.zeros((*part.shape, 0)) for part in parts) if slopes else ()
        return Evaluated(parts, tuple(s[..., :n] for s in slopes), tuple(s[..., n:] for s in slopes), none)

    # ---------------------------------------------------------------- rows and starts
    def observation(self, z: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.observation`."""
        t, u, condition = data
        with np.errstate(all="ignore"):
            point = self._point(k, condition, z.shape[1], derivatives)
            y = point.observed(t, point.seeded(z), u)
        n, count = z.shape[1], len(z)
        slopes = y.slopes(count, point.p)
        parts = y.value(count), slopes[..., :n]
        return self._split(parts, (slopes, y.bends(count, n, point.p)) if derivatives else (), n)

    def start(self, starts: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.start`."""
        variance, condition = data
        n = starts.shape[1]
        with np.errstate(all="ignore"):
            point = self._point(k, condition, n, derivatives)
            seed, equations = point.seeded(starts), self.local.problem.module.equations
            z = point.of_states(Vector(equations.initial(jet_arithmetic(), seed, condition, point.constants)))
        slopes = z.slopes(len(starts), point.p)
        a = slopes[..., :n]
        p = (a * variance[:, None]) @ a.transpose(0, 2, 1)
        if not derivatives:
            return self._split((z.value(len(starts)), p), (), n)
        part = np.matmul((a * variance[:, None])[:, None], z.bends(len(starts), n, point.p))
        return self._split((z.value(len(starts)), p), (slopes, part + part.transpose(0, 2, 1, 3)), n)

    # ---------------------------------------------------------------- linear models
    def factors(self, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.factors`."""
        u, condition = data
        n = len(self.local.problem.model.states)
        with np.errstate(all="ignore"):
            point = self._point(k, condition, n, derivatives)
            zero = point.seeded(np.zeros((len(k), n)))
            drift, spread = point.drift(np.zeros(len(k)), zero, u), point.spread(zero, u)
        p, count = point.p, len(k)
        slopes = (drift.bends(count, n, p), spread.slopes(count, p)) if derivatives else ()
        return self._split((drift.slopes(count, p)[..., :n], spread.value(count)), slopes, n)

    def push(self, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.push`."""
        t, h, u, doses, condition = data
        n = len(self.local.problem.model.states)
        with np.errstate(all="ignore"):
            point = replace(self._point(k, condition, n, derivatives), bent=False)
            zero = point.seeded(np.zeros((len(k), n)))
            found = [point.drift(t, zero, u[:, 0])]
            if not self.local.steady:
                middle = point.drift(t + 0.5 * h, zero, 0.5 * (u[:, 0] + u[:, -1]))
                end, length, begin = point.drift(t + h, zero, u[:, -1]), np.where(h > 0, h, 1.0), found[0]
                found += [(middle * 4.0 - begin * 3.0 - end) / length, (begin - middle * 2.0 + end) * (2 / length**2)]
            found.append(point.dosed(zero, doses) if doses.shape[-1] else Vector([0.0] * n))
        # What doses add does not depend on the state: its derivative there is that of the state itself.
        slopes = tuple(part.slopes(len(k), point.p) for part in found) if derivatives else ()
        return self._split(tuple(part.value(len(k)) for part in found), slopes, n)


def _after(jump: Vector, found: tuple[Arrays, Arrays], point: _Point) -> Evaluated:
    """A sub-step after doses, by the coordinates before them."""
    (mean, a, q), slopes = found
    n, count = point.n, len(mean)
    d_jump = jump.slopes(count, point.p)
    whole = (mean, a @ d_jump[..., :n], q)
    if not point.bent:
        return Evaluated(whole)
    d_mean, d_a, d_q = (_along(each, d_jump, n) for each in slopes)
    d_whole = _product(a, d_jump[..., :n], d_a, jump.bends(count, n, point.p))
    return Forward._split(whole, (d_mean, d_whole, d_q), n)


def _along(slopes: Array, place: Array, n: int) -> Array:
    """Derivatives [B, ..., p] at a place that moves by `place` [B, n, p] with the variables."""
    flat = slopes.reshape(len(slopes), -1, slopes.shape[-1])
    found: Array = np.matmul(flat[..., :n], place)
    found[..., n:] += flat[..., n:]
    return found.reshape(slopes.shape)


def _product(a: Array, b: Array, da: Array, db: Array) -> Array:
    """The derivatives [B, n, n, p] of the products of matrices [B, n, n]."""
    left = np.matmul(b.transpose(0, 2, 1)[:, None], da)
    right = np.matmul(a, db.reshape(*db.shape[:2], -1)).reshape(da.shape)
    return np.asarray(left + right)
