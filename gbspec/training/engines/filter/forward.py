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
from gbspec.training.engines.filter.jets import Jet, jet, jet_arithmetic
from gbspec.training.engines.filter.local import Arrays, Evaluated, Local


def covers(model: Model) -> bool:
    """Whether equations need no networks, tables or searches."""
    return not (model.networks or model.tables or model.algebraics or model.steady or model.delays)


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

    def seeded(self, z: Array) -> Jet:
        """Coordinates [B, n] as variables."""
        first = np.zeros((1, self.n, self.p))
        first[0, :, : self.n] = np.eye(self.n)
        return Jet(z, first, None, self.n if self.bent else 0)

    def states(self, z: Jet) -> Any:
        """The states of coordinates."""
        ops, log = jet_arithmetic(), self.local.coordinates.log
        if self.local.coordinates.plain:
            return z
        return ops.pack(z, [ops.exp(x) if logged else x for x, logged in zip(ops.unpack(z), log, strict=True)])

    def of_states(self, x: Any) -> Any:
        """The coordinates of states."""
        ops, log = jet_arithmetic(), self.local.coordinates.log
        if self.local.coordinates.plain:
            return x
        return ops.pack(x, [ops.log(each) if logged else each for each, logged in zip(ops.unpack(x), log, strict=True)])

    def spread(self, z: Jet, u: Array) -> Jet:
        """The sizes of the disturbances [B, n]."""
        equations = self.local.problem.module.equations
        return jet(equations.diffusions(jet_arithmetic(), self.states(z), self.condition, u, self.constants))

    def drift(self, t: Any, z: Any, u: Array) -> Jet:
        """The drift of the coordinates [B, n]."""
        ops, coordinates = jet_arithmetic(), self.local.coordinates
        x = self.states(z)
        rate = self.local.problem.module.equations.rhs(ops, t, x, self.condition, u, self.constants, ())
        if coordinates.plain:
            return jet(rate)
        sizes, parts = ops.unpack(self.spread(z, u)), []
        for i, (each, state) in enumerate(zip(ops.unpack(rate), ops.unpack(x), strict=True)):
            parts.append(each / state - 0.5 * sizes[i] ** 2 if coordinates.log[i] else each)
        return jet(ops.pack(x, parts))

    def dosed(self, z: Jet, amounts: Array) -> Jet:
        """The coordinates after doses [B, kinds]."""
        ops, model = jet_arithmetic(), self.local.problem.model
        terms = self.local.problem.module.equations.doses(ops, self.condition, self.constants)
        parts = list(ops.unpack(self.states(z)))
        for kind, (fraction, _) in enumerate(terms):
            state = model.state_index[model.doses[kind].state]
            parts[state] = parts[state] + amounts[:, kind] * jet(fraction)
        return jet(self.of_states(ops.pack(z, parts)))

    def observed(self, t: Array, z: Jet, u: Array) -> Jet:
        """The predicted channels [B, C]."""
        ops, log, x = jet_arithmetic(), self.local.log_channels, self.states(z)
        equations = self.local.problem.module.equations
        y = equations.observe(ops, t, x, self.condition, u, self.constants, ())
        if not log.any():
            return jet(y)
        parts = [
            ops.log(ops.where(jet(each).value > LEAST, each, LEAST)) if logged else each
            for each, logged in zip(ops.unpack(y), log, strict=True)
        ]
        return jet(ops.pack(y, parts))


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
                return self._split(*self._undosed(point, z, (t, h, u)), z.shape[1])
            jump = point.dosed(point.seeded(z), doses)
            return _after(jump, *self._undosed(point, jump.value, (t, h, u)), point)

    def _undosed(self, point: _Point, z: Array, data: Arrays) -> tuple[Arrays, Arrays]:
        """Mean, transition and added covariance of a sub-step, and their derivatives [B, ..., p]."""
        t, h, u = data
        ops, equations = jet_arithmetic(), self.local.problem.module.equations
        nodes, n, p = tuple(u[:, i] for i in range(u.shape[1])), z.shape[1], point.p
        seed, count = point.seeded(z), len(z)
        end = equations.step(ops, point.drift, equations.grid(ops, t, h), seed, nodes)
        first, last = point.drift(t, seed, nodes[0]), point.drift(t + h, point.seeded(end.value), nodes[-1])
        d_end = end.derivatives((count, n), p)
        a, f, g = (part.derivatives((count, n), p)[..., :n] for part in (end, first, last))
        size = h[:, None, None]
        middle = 0.5 * (a + np.eye(n)) + 0.125 * size * (g - a @ f)
        between = nodes[self.local.middle] if self.local.middle is not None else 0.5 * (nodes[0] + nodes[-1])
        places = (z, nodes[0]), (0.5 * (z + end.value), between), (end.value, nodes[-1])
        spreads = [point.spread(point.seeded(where), inputs) for where, inputs in places]
        factors = (a, middle, np.eye(n)[None])
        x = [m * s.value[:, None] for m, s in zip(factors, spreads, strict=True)]
        weights = (size / 6, 4 * size / 6, size / 6)
        q = sum(w * (each @ each.transpose(0, 2, 1)) for w, each in zip(weights, x, strict=True))
        if not point.bent:
            return (end.value, a, np.asarray(q)), ()
        da, df = (part.bends((count, n), n, p) for part in (end, first))
        dg = _along(last.bends((count, n), n, p), d_end, n)
        d_middle = 0.5 * da + 0.125 * size[..., None] * (dg - _product(a, f, da, df))
        one = np.broadcast_to(np.concatenate([np.eye(n), np.zeros((n, p - n))], 1), (count, n, p))
        dq = np.zeros((count, n, n, p))
        moves = zip(weights, x, factors, (da, d_middle, None), spreads, (one, 0.5 * (one + d_end), d_end), strict=True)
        for w, each, factor, d_factor, spread, d_place in moves:
            ds = _along(spread.derivatives((count, n), p), d_place, n)
            dx = factor[..., None] * ds[:, None]
            if d_factor is not None:
                dx = dx + d_factor * spread.value[:, None, :, None]
            part = np.einsum("bijp,bkj->bikp", dx, each, optimize=False)
            dq += w[..., None] * (part + part.transpose(0, 2, 1, 3))
        return (end.value, a, np.asarray(q)), (d_end, da, dq)

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
        n, shape = z.shape[1], y.shape
        slopes = y.derivatives(shape, point.p)
        return self._split(
            (y.value, slopes[..., :n]), (slopes, y.bends(shape, n, point.p)) if derivatives else (), n
        )

    def start(self, starts: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.start`."""
        variance, condition = data
        n = starts.shape[1]
        with np.errstate(all="ignore"):
            point = self._point(k, condition, n, derivatives)
            seed, equations = point.seeded(starts), self.local.problem.module.equations
            z = jet(point.of_states(equations.initial(jet_arithmetic(), seed, condition, point.constants)))
        slopes = z.derivatives(z.shape, point.p)
        a = slopes[..., :n]
        p = (a * variance[:, None]) @ a.transpose(0, 2, 1)
        if not derivatives:
            return self._split((z.value, p), (), n)
        part = np.einsum("bijp,bj,bkj->bikp", z.bends(z.shape, n, point.p), variance, a, optimize=False)
        return self._split((z.value, p), (slopes, part + part.transpose(0, 2, 1, 3)), n)

    # ---------------------------------------------------------------- linear models
    def factors(self, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.factors`."""
        u, condition = data
        n = len(self.local.problem.model.states)
        with np.errstate(all="ignore"):
            point = self._point(k, condition, n, derivatives)
            zero = point.seeded(np.zeros((len(k), n)))
            drift, spread = point.drift(np.zeros(len(k)), zero, u), point.spread(zero, u)
        shape, p = (len(k), n), point.p
        f, s = drift.derivatives(shape, p)[..., :n], np.broadcast_to(spread.value, shape)
        slopes = (drift.bends(shape, n, p), spread.derivatives(shape, p)) if derivatives else ()
        return self._split((f, s), slopes, n)

    def push(self, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.push`."""
        t, h, u, doses, condition = data
        n = len(self.local.problem.model.states)
        with np.errstate(all="ignore"):
            point = replace(self._point(k, condition, n, derivatives), bent=False)
            zero = point.seeded(np.zeros((len(k), n)))
            added = point.dosed(zero, doses) if doses.shape[-1] else jet(np.zeros((len(k), n)))
            found = [point.drift(t, zero, u[:, 0])]
            if not self.local.steady:
                middle = point.drift(t + 0.5 * h, zero, 0.5 * (u[:, 0] + u[:, -1]))
                end, length = point.drift(t + h, zero, u[:, -1]), np.where(h > 0, h, 1.0)[:, None]
                begin = found[0]
                found += [(4 * middle - 3 * begin - end) / length, 2 * (begin - 2 * middle + end) / length**2]
        shape = (len(k), n)
        parts = [np.broadcast_to(part.value, shape) for part in (*found, added)]
        # What doses add does not depend on the state: its derivative there is that of the state itself.
        slopes = [part.derivatives(shape, point.p) for part in (*found, added)] if derivatives else []
        return self._split(tuple(parts), tuple(slopes), n)


def _after(jump: Jet, parts: Arrays, slopes: Arrays, point: _Point) -> Evaluated:
    """A sub-step after doses, by the coordinates before them."""
    n, count = point.n, len(jump.value)
    d_jump = jump.derivatives((count, n), point.p)
    mean, a, q = parts
    whole = (mean, a @ d_jump[..., :n], q)
    if not point.bent:
        return Evaluated(whole)
    d_mean, d_a, d_q = (_along(each, d_jump, n) for each in slopes)
    d_whole = _product(a, d_jump[..., :n], d_a, jump.bends((count, n), n, point.p))
    return Forward._split(whole, (d_mean, d_whole, d_q), n)


def _along(slopes: Array, place: Array, n: int) -> Array:
    """Derivatives [B, ..., p] at a place that moves by `place` [B, n, p] with the variables."""
    flat = slopes.reshape(len(slopes), -1, slopes.shape[-1])
    found = np.matmul(flat[..., :n], place)
    found[..., n:] += flat[..., n:]
    return found.reshape(slopes.shape)


def _product(a: Array, b: Array, da: Array, db: Array) -> Array:
    """The derivatives [B, n, n, p] of the products of matrices [B, n, n]."""
    left = np.matmul(b.transpose(0, 2, 1)[:, None], da)
    right = np.matmul(a, db.reshape(*db.shape[:2], -1)).reshape(da.shape)
    return np.asarray(left + right)

