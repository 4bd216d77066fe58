"""Hopf and fold curves in a plane of two parameters, with their codimension-two points.

Both are zero sets of extended systems, followed by the same pseudo-arclength continuation with exact Jacobians:

    fold: f = 0, A v = 0, <v, v> = 1
    Hopf: f = 0, A r + w s = 0, A s - w r = 0, <q0, r> = 1, <q0, s> = 0

with A = df/dx and q0 a fixed vector (Moore and Spence, SIAM J. Numer. Anal. 17, 1980; Griewank and Reddien, IMA J.
Numer. Anal. 3, 1983). On a Hopf curve the first Lyapunov coefficient changes sign at Bautin points, and
w vanishes at Bogdanov-Takens points; a fold curve turns back in the plane at cusps (Kuznetsov, chapter 8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Literal

import numpy as np

from gbspec.analysis.bifurcation.curve import Curve, CurvePoint, Steps, balanced
from gbspec.analysis.bifurcation.hopf import critical_pair, normal_form
from gbspec.analysis.systems import Box, Compiled, Family, System
from gbspec.arrays import Array, ComplexArray
from gbspec.backends import Casadi

Kind = Literal["bautin", "bogdanov_takens", "cusp"]


@dataclass(frozen=True)
class PlanePoint:
    """A point of a curve: the two parameters, the state [n]; on a Hopf curve also the frequency and l1.

    `outside` names the quantities outside their trained (else plausible) ranges.
    """

    values: tuple[float, float]
    state: Array
    frequency: float | None = None
    l1: float | None = None
    outside: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlaneCurve:
    """A Hopf or fold curve, the codimension-two points on it, and the reasons for its two ends."""

    kind: Literal["hopf", "fold"]
    parameters: tuple[str, str]
    states: tuple[str, ...]
    points: tuple[PlanePoint, ...]
    special: tuple[tuple[Kind, PlanePoint], ...]
    ends: tuple[str, str]

    def to_json(self) -> dict[str, object]:
        """Keys type, parameters, points, special, ends."""

        def entry(point: PlanePoint) -> dict[str, object]:
            return {
                "values": dict(zip(self.parameters, point.values, strict=True)),
                "state": dict(zip(self.states, map(float, point.state), strict=True)),
                "frequency": point.frequency,
                "l1": point.l1,
                "outside": list(point.outside),
            }

        return {
            "type": self.kind,
            "parameters": list(self.parameters),
            "points": [entry(point) for point in self.points],
            "special": [{"type": kind, **entry(point)} for kind, point in self.special],
            "ends": list(self.ends),
        }


class PlaneFamily:
    """x' = f(x, a, b) for two parameters, as extended systems of CasADi."""

    def __init__(self, system: System, first: str, second: str) -> None:
        low, _ = system.range(second)
        placeholder = system.values.get(second, low if np.isfinite(low) else 1.0)
        # A family in the first parameter checks the names and that no other number is missing.
        self.family = Family(system.with_values({second: placeholder}), first)
        Family(system.with_values({first: system.values.get(first, 1.0)}), second)
        self.system, self.names, self.size = system, (first, second), system.size

    def at(self, second: float) -> Family:
        """The family in the first parameter at a value of the second."""
        return Family(self.system.with_values({self.names[1]: second}), self.names[0])

    def _field(self) -> tuple[Casadi, Casadi, Casadi]:
        """MX symbols x, (a, b) and f."""
        import casadi

        p = casadi.MX.sym("p", 2)
        x, f = self.system.symbolic_rhs({name: p[i] for i, name in enumerate(self.names)})
        return x, p, f

    def fold(self) -> Compiled:
        """(x, v, a, b) -> the extended system of folds [2n + 1] and its Jacobian."""
        import casadi

        x, p, f = self._field()
        v = casadi.MX.sym("v", self.size)
        equations = casadi.vertcat(f, casadi.jtimes(f, x, v), casadi.dot(v, v) - 1.0)
        return _with_jacobian("fold", equations, x, v, p)

    def hopf(self, reference: Array) -> Compiled:
        """(x, r, s, w, a, b) -> the extended system of Hopf points [3n + 2] and its Jacobian; q0 is `reference`."""
        import casadi

        x, p, f = self._field()
        r, s, w = casadi.MX.sym("r", self.size), casadi.MX.sym("s", self.size), casadi.MX.sym("w")
        q0 = casadi.DM(reference)
        equations = casadi.vertcat(
            f,
            casadi.jtimes(f, x, r) + w * s,
            casadi.jtimes(f, x, s) - w * r,
            casadi.dot(q0, r) - 1.0,
            casadi.dot(q0, s),
        )
        return _with_jacobian("hopf", equations, x, r, s, w, p)

    def bogdanov_takens(self, reference: Array) -> Compiled:
        """(x, r, g, a, b) -> f, A r, A g - r, <q0, r> - 1, <q0, g> [3n + 2]: regular where w = 0, and its Jacobian."""
        import casadi

        x, p, f = self._field()
        r, g = casadi.MX.sym("r", self.size), casadi.MX.sym("g", self.size)
        q0 = casadi.DM(reference)
        equations = casadi.vertcat(
            f, casadi.jtimes(f, x, r), casadi.jtimes(f, x, g) - r, casadi.dot(q0, r) - 1.0, casadi.dot(q0, g)
        )
        return _with_jacobian("bogdanov_takens", equations, x, r, g, p)

    @cached_property
    def _derivatives(self) -> tuple[Compiled, Compiled, Compiled]:
        """(x, p) -> A, (x, p, u, v) -> B(u, v), (x, p, u, v, w) -> C(u, v, w)."""
        import casadi

        x, p, f = self._field()
        u, v, w = (casadi.MX.sym(name, self.size) for name in "uvw")
        second = casadi.jtimes(casadi.jtimes(f, x, u), x, v)
        return (
            Compiled(casadi.Function("first", [x, p], [casadi.jacobian(f, x)])),
            Compiled(casadi.Function("second", [x, p, u, v], [second])),
            Compiled(casadi.Function("third", [x, p, u, v, w], [casadi.jtimes(second, x, w)])),
        )

    def point(self, z: Array, frequency: float | None = None, l1: float | None = None) -> PlanePoint:
        """The point of a curve at `z`, which begins with the state [n] and ends with both parameters."""
        state, values = z[: self.size], (float(z[-2]), float(z[-1]))
        system = self.system.with_values(dict(zip(self.names, values, strict=True)))
        return PlanePoint(values, state, frequency, l1, system.outside(state))

    def lyapunov(self, state: Array, values: Array) -> float:
        """The first Lyapunov coefficient at a Hopf point: state [n], both parameters [2]."""
        first, second, third = self._derivatives
        return normal_form(
            first(state, values)[0].reshape(self.size, self.size),
            lambda u, v: second(state, values, u, v)[0],
            lambda u, v, w: third(state, values, u, v, w)[0],
        ).l1


def _with_jacobian(name: str, equations: Casadi, *symbols: Casadi) -> Compiled:
    """The equations and their Jacobian with respect to all symbols, concatenated."""
    import casadi

    jacobian = casadi.horzcat(*(casadi.jacobian(equations, symbol) for symbol in symbols))
    return Compiled(casadi.Function(name, list(symbols), [equations, jacobian]))


def fold_curve(
    system: System, names: tuple[str, str], boxes: tuple[Box, Box], state: Array, values: tuple[float, float]
) -> PlaneCurve:
    """The curve of folds through one: `state` [n] at `values` of the two parameters, within `boxes`."""
    family = PlaneFamily(system, *names)
    jacobian = family.at(values[1]).linear(state, values[0])[1].reshape(family.size, family.size)
    null = np.linalg.svd(jacobian)[2][-1]
    function = family.fold()
    n = family.size
    scale = np.concatenate([system.scale, np.ones(n), _widths(boxes)])
    tracer = _Tracer(family, function, (n, n, 2), scale, boxes)

    def describe(y: Array) -> PlanePoint:
        return family.point(y * scale)

    def cusp(point: CurvePoint) -> float:
        # Along the curve both parameters' components of the tangent vanish at a cusp: their projection on the
        # previous tangent changes sign there.
        return float(point.tangent[-2:] @ tracer.heading)

    return tracer.both_ways("fold", np.concatenate([state, null, values]) / scale, describe, (("cusp", cusp),))


def hopf_curve(
    system: System, names: tuple[str, str], boxes: tuple[Box, Box], state: Array, values: tuple[float, float]
) -> PlaneCurve:
    """The curve of Hopf points through one: `state` [n] at `values` of the two parameters, within `boxes`."""
    family = PlaneFamily(system, *names)
    n = family.size
    jacobian = family.at(values[1]).linear(state, values[0])[1].reshape(n, n)
    frequency, q, _ = critical_pair(jacobian)
    reference = _reference(q)
    # q is rotated so that <q0, Re q> = 1 and <q0, Im q> = 0 hold at the start.
    q = q / complex(reference @ q)
    function = family.hopf(reference)
    scale = np.concatenate([system.scale, np.ones(2 * n), [frequency], _widths(boxes)])
    tracer = _Tracer(family, function, (n, n, n, 1, 2), scale, boxes, _Takens(family, reference, scale))

    def lyapunov(y: Array) -> float:
        z = y * scale
        return family.lyapunov(z[:n], z[-2:])

    def describe(y: Array) -> PlanePoint:
        z = y * scale
        return family.point(z, float(z[3 * n]), lyapunov(y))

    start = np.concatenate([state, q.real, q.imag, [frequency], values]) / scale
    return tracer.both_ways("hopf", start, describe, (("bautin", lambda point: lyapunov(point.y)),))


def _reference(q: ComplexArray) -> Array:
    """The vector q0 [n] of the extended system for an eigenvector q [n] (complex): as far from being orthogonal to
    either axis of the ellipse that Re q and Im q span as it can be.

    Where w vanishes r becomes the null vector of A and s vanishes; if q0 were orthogonal to that null vector, s would
    grow without bound instead. It is near one of the axes, and which one is not known before.
    """
    axes, lengths, _ = np.linalg.svd(np.column_stack([q.real, q.imag]), full_matrices=False)
    return np.asarray((axes[:, 0] / lengths[0] - axes[:, 1] / lengths[1]) / np.sqrt(2), dtype=np.float64)


def _newton(function: Compiled, sizes: tuple[int, ...], guess: Array) -> Array | None:
    """A zero of a square system near `guess`."""
    cuts, z = list(np.cumsum(sizes))[:-1], guess
    for _ in range(30):
        f, derivative = function(*np.split(z, cuts))
        try:
            step = np.linalg.solve(derivative, f)
        except np.linalg.LinAlgError:
            return None
        z = z - step
        if not np.isfinite(z).all():
            return None
        if np.max(np.abs(step)) < 1e-11 * max(1.0, float(np.max(np.abs(z)))):
            return z
    return None


def _widths(boxes: tuple[Box, Box]) -> list[float]:
    return [high - low for low, high in boxes]


class _Takens:
    """Bogdanov-Takens points, at which a Hopf curve ends since its frequency passes through zero.

    `reference` [n] is the vector q0 of the extended system, `scale` [3n + 3] that of the curve's variables.
    """

    def __init__(self, family: PlaneFamily, reference: Array, scale: Array) -> None:
        self.family, self.scale, self.size = family, scale, family.size
        self.function = family.bogdanov_takens(reference)

    def passed(self, a: CurvePoint, b: CurvePoint) -> bool:
        """Whether the frequency changes its sign from one point of the curve to the next."""
        return bool(a.y[3 * self.size] * b.y[3 * self.size] <= 0.0)

    def between(self, a: CurvePoint, b: CurvePoint) -> PlanePoint | None:
        """The point between two points of the curve; None if Newton's iteration does not converge."""
        n = self.size
        z = (b if abs(b.y[3 * n]) < abs(a.y[3 * n]) else a).y * self.scale
        guess = np.concatenate([z[: 2 * n], z[2 * n : 3 * n] / z[3 * n], z[-2:]])
        found = _newton(self.function, (n, n, n, 2), guess)
        return None if found is None else self.family.point(found, 0.0)


class _Tracer:
    """Follows the zero set of an extended system inside a box of the two last variables."""

    def __init__(
        self,
        family: PlaneFamily,
        function: Compiled,
        sizes: tuple[int, ...],
        scale: Array,
        boxes: tuple[Box, Box],
        takens: _Takens | None = None,
    ) -> None:
        self.family, self.function, self.scale, self.boxes = family, function, scale, boxes
        self.cuts = list(np.cumsum(sizes))[:-1]
        self.curve = Curve(self._evaluate)
        self.heading = np.zeros(2)
        self.takens = takens

    def _evaluate(self, y: Array) -> tuple[Array, Array]:
        f, derivative = self.function(*np.split(y * self.scale, self.cuts))
        return balanced(f, derivative * self.scale)

    def both_ways(
        self,
        kind: Literal["hopf", "fold"],
        start: Array,
        describe: Callable[[Array], PlanePoint],
        tests: tuple[tuple[Kind, Callable[[CurvePoint], float]], ...],
    ) -> PlaneCurve:
        """The curve through a point in both directions."""
        names, states = self.family.names, self.family.system.states
        derivative = self._evaluate(start)[1]
        tangent = np.linalg.svd(derivative)[2][-1]
        point = self.curve.point(start, tangent)
        if point is None:
            return PlaneCurve(kind, names, states, (), (), ("no point of the curve at the start",) * 2)
        ahead, special, end = self._follow(point, tests)
        back = CurvePoint(point.y, -point.tangent, point.derivative)
        behind, before, start_end = self._follow(back, tests) if end != "closed" else ([point], [], end)
        return PlaneCurve(
            kind,
            names,
            states,
            tuple(describe(one.y) for one in behind[:0:-1] + ahead),
            tuple((name, one if isinstance(one, PlanePoint) else describe(one.y)) for name, one in before + special),
            (start_end, end),
        )

    def _follow(
        self, start: CurvePoint, tests: tuple[tuple[Kind, Callable[[CurvePoint], float]], ...]
    ) -> tuple[list[CurvePoint], list[tuple[Kind, CurvePoint | PlanePoint]], str]:
        points, special = [start], list[tuple[Kind, CurvePoint | PlanePoint]]()
        before = start
        self.heading = start.tangent[-2:]
        for point, length in self.curve.walk(start, Steps(first=0.002, most=0.02, turn=0.98)):
            if self.takens is not None and self.takens.passed(before, point):
                found = self.takens.between(before, point)
                special.extend([("bogdanov_takens", found)] if found is not None else [])
                return points, special, "bogdanov_takens"
            for name, test in tests:
                if test(before) * test(point) < 0.0:
                    located = self.curve.locate(before, length, test, 1e-11)
                    special.extend([(name, located)] if located is not None else [])
            at_edge = self._edge(before, point, length)
            if at_edge is not None:
                return [*points, at_edge], special, "range"
            if not self.family.system.admissible((point.y * self.scale)[: self.family.size]):
                return points, special, "a state falls below its range"
            points.append(point)
            if np.any(np.abs(point.tangent[-2:]) > 1e-3):
                self.heading = point.tangent[-2:]
            if len(points) > 10 and np.max(np.abs(point.y - start.y)) < length and point.tangent @ start.tangent > 0.9:
                passed = (point.y - start.y) @ start.tangent > 0.0
                return [*(points[:-1] if passed else points), start], special, "closed"
            if len(points) > 3000:
                return points, special, "number of points"
            before = point
        return points, special, "no step converged"

    def _edge(self, before: CurvePoint, point: CurvePoint, length: float) -> CurvePoint | None:
        """The point at which a step leaves the box, or None if it stays inside."""
        size = len(self.scale)
        for i, (low, high) in zip((size - 2, size - 1), self.boxes, strict=True):
            value = point.y[i] * self.scale[i]
            if not low <= value <= high:
                end = (low if value < low else high) / self.scale[i]
                if before.y[i] == end:
                    return before
                return self.curve.locate(before, length, partial(_beyond, i, end)) or before
        return None


def _beyond(index: int, end: float, point: CurvePoint) -> float:
    """The distance of a variable of a point beyond an end."""
    return float(point.y[index] - end)
