"""The functions of `local`, for models without networks, by forward mode in numpy: the same numbers in less time.

`Local` differentiates with torch, which costs a fixed time for each of thousands of small operations; `Forward` is
chosen where it can be, and the tests compare both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import LEAST, Model
from gbspec.training.engines.filter.jets import Jet, Vector, jet, jet_arithmetic
from gbspec.training.engines.filter.local import Arrays, Evaluated, Local


def covers(model: Model) -> bool:
    """Whether equations need no networks, vectors, tables or searches."""
    return not (model.networks or model.arrays or model.tables or model.algebraics or model.steady or model.delays)


@dataclass(frozen=True)
class _Point:
    """The model at B points: conditions [B, c], and constants [B, k], jets whose derivatives follow those of `n`
    coordinates where these are wanted; p variables in all. `order`: that of the derivatives in coordinates."""

    local: Local
    condition: Array
    constants: tuple[Any, ...]
    n: int
    p: int
    order: int

    def seeded(self, z: Array) -> Vector:
        """Coordinates [B, n] as variables."""
        if not self.order:
            return Vector(z.T)
        unit, n = np.eye(self.p)[:, None], self.n if self.order > 1 else 0
        return Vector(Jet(z[:, i], unit[i], None, n) for i in range(self.n))

    def states(self, z: Vector) -> Vector:
        """The states of coordinates."""
        if self.local.coordinates.plain:
            return z
        exp, coordinates = jet_arithmetic().exp, self.local.coordinates.each
        return Vector(one.state(exp, each) for each, one in zip(z, coordinates, strict=True))

    def of_states(self, x: Vector) -> Vector:
        """The coordinates of states."""
        if self.local.coordinates.plain:
            return x
        log, coordinates = jet_arithmetic().log, self.local.coordinates.each
        return Vector(one.of(log, each) for each, one in zip(x, coordinates, strict=True))

    def spread(self, x: Vector, u: Array) -> Vector:
        """The sizes of the disturbances [n] at states."""
        equations = self.local.problem.module.equations
        found: Vector = equations.diffusions(jet_arithmetic(), x, self.condition, u, self.constants)
        return found

    def drift(self, t: Any, z: Vector, u: Array) -> Vector:
        """The drift of the coordinates [n]."""
        x = self.states(z)
        equations = self.local.problem.module.equations
        rate: Vector = equations.rhs(jet_arithmetic(), t, x, self.condition, u, self.constants, ())
        if self.local.coordinates.plain:
            return rate
        sizes, exp = self.spread(x, u), jet_arithmetic().exp
        parts = zip(self.local.coordinates.each, rate, sizes, z, x, strict=True)
        return Vector(one.drift(exp, f, size * size, at, state) for one, f, size, at, state in parts)

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

    def _point(self, k: Array, condition: Array, n: int, order: int, varied: bool) -> _Point:
        """The points, with derivatives in coordinates of this order, and with `varied` in the constants."""
        known = tuple(float(constant.value) for constant in self.local.problem.model.constants)
        p = n + (k.shape[1] if varied else 0)
        learned: list[Any] = [k[:, i] for i in range(k.shape[1])]
        if varied:
            bent = n if order > 1 else 0
            learned = [Jet(value, np.eye(p)[None, n + i], None, bent) for i, value in enumerate(learned)]
        return _Point(self.local, condition, (*known, *learned), n, p, order)

    # ---------------------------------------------------------------- sub-steps
    def field(self, z: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.field`."""
        t, u, condition = data
        with np.errstate(all="ignore"):
            point = self._point(k, condition, z.shape[1], int(derivatives), derivatives)
            seed = point.seeded(z)
            sizes = point.spread(point.states(seed), u)
            squares = Vector(each * each for each in sizes)
            return self._all((point.drift(t, seed, u), squares), len(z), point, derivatives)

    def dosed(self, z: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.dosed`."""
        doses, condition = data
        with np.errstate(all="ignore"):
            point = self._point(k, condition, z.shape[1], int(derivatives), derivatives)
            return self._all((point.dosed(point.seeded(z), doses),), len(z), point, derivatives)

    def _all(self, parts: tuple[Vector, ...], count: int, point: _Point, derivatives: bool) -> Evaluated:
        """Values [B, m], and where wanted their first derivatives."""
        values = tuple(part.value(count) for part in parts)
        slopes = tuple(part.slopes(count, point.p) for part in parts) if derivatives else ()
        return self._split(values, slopes, point.n)

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
            point = self._point(k, condition, z.shape[1], int(derivatives), derivatives)
            y = point.observed(t, point.seeded(z), u)
        return self._all((y,), len(z), point, derivatives)

    def tangent(self, z: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.tangent`."""
        t, u, condition = data
        n, count = z.shape[1], len(z)
        with np.errstate(all="ignore"):
            point = self._point(k, condition, n, 2 if derivatives else 1, derivatives)
            y = point.observed(t, point.seeded(z), u)
        slopes = y.slopes(count, point.p)
        parts = y.value(count), slopes[..., :n]
        return self._split(parts, (slopes, y.bends(count, n, point.p)) if derivatives else (), n)

    def start(self, starts: Array, k: Array, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.start`."""
        variance, condition = data
        n = starts.shape[1]
        with np.errstate(all="ignore"):
            point = self._point(k, condition, n, 2 if derivatives else 1, derivatives)
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
            point = self._point(k, condition, n, 2 if derivatives else 1, derivatives)
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
            point = self._point(k, condition, n, int(derivatives), derivatives)
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
