"""Branches of steady states over one parameter: through folds, with stability, folds, Hopf points and branch points.

The curve f(x, p) = 0 is followed by pseudo-arclength continuation with exact Jacobians. Test functions (Kuznetsov,
Elements of Applied Bifurcation Theory, 3rd ed., section 10.2): the parameter's component of the tangent for folds, the
k-th largest real part of the eigenvalues for Hopf points, and the determinant of the Jacobian bordered by the tangent
for branch points. Sign changes are located by Brent's method along the curve, branch points by an extended system.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gbspec.analysis.bifurcation.branch_point import branch_point, branch_point_at, crossing_tangents, singular
from gbspec.analysis.bifurcation.curve import BEYOND, Curve, CurvePoint, Steps, balanced, row_sizes
from gbspec.analysis.systems import Family, axis_width, ordered_eigenvalues
from gbspec.arrays import Array, ComplexArray

Kind = Literal["fold", "nonsmooth_fold", "hopf", "branch", "cycle_fold", "period_doubling", "torus"]

JUMP = 0.01
"""DF jumps where it changes by more, relative to the size of its rows, over twice `BEYOND`."""


@dataclass(frozen=True)
class SteadyPoint:
    """A steady state [n] at one value of the parameter, with the Jacobian's eigenvalues by decreasing real part.

    `outside` names the quantities outside their trained (else plausible) ranges.
    """

    value: float
    state: Array
    eigenvalues: ComplexArray
    outside: tuple[str, ...] = ()

    @property
    def stable(self) -> bool:
        """Whether all eigenvalues are in the left half plane."""
        return bool(np.all(self.eigenvalues.real < -axis_width(self.eigenvalues)))


@dataclass(frozen=True)
class SpecialPoint:
    """A bifurcation point located on its branch; `state` is [n] (for a cycle: a point on it).

    For a Hopf point: `frequency` (the critical eigenvalue's imaginary part), `period` of the cycles born there, the
    first Lyapunov coefficient `l1` and the criticality that follows from it. `branch` is the index of its branch, and
    `branches` are all that cross at a branch point. `sd` and the 90 % `interval` of `value` follow from the uncertainty
    of the fit; None where that is not known.
    """

    kind: Kind
    value: float
    state: Array
    branch: int = 0
    frequency: float | None = None
    l1: float | None = None
    criticality: Literal["super", "sub"] | None = None
    period: float | None = None
    interval: tuple[float, float] | None = None
    sd: float | None = None
    branches: tuple[int, ...] = ()


@dataclass(frozen=True)
class Branch:
    """A branch of steady states in the order of continuation, and the reasons for its two ends."""

    points: tuple[SteadyPoint, ...]
    ends: tuple[str, str] = ("", "")

    @property
    def values(self) -> Array:
        """The parameter [N] along the branch."""
        return np.array([point.value for point in self.points])

    @property
    def states(self) -> Array:
        """The states [N, n] along the branch."""
        return np.array([point.state for point in self.points])


@dataclass
class Followed:
    """One direction of a branch during continuation: points, special points and the reason for its end."""

    points: list[CurvePoint] = field(default_factory=list)
    special: list[tuple[Kind, CurvePoint]] = field(default_factory=list)
    end: str = ""


class SteadyCurve:
    """The curve of steady states of a family over `low` <= p <= `high`, in scaled variables y = (x/scale, p/width)."""

    def __init__(self, family: Family, low: float, high: float, steps: Steps | None = None) -> None:
        self.family = family
        self.low, self.high = low, high
        self.scale = np.append(family.system.scale, high - low)
        self.steps = steps or Steps()
        self.curve = Curve(self._evaluate)
        box_low, box_high = family.system.start_box
        width = box_high - box_low
        self._far = box_low - 10.0 * width, box_high + 10.0 * width

    def _evaluate(self, y: Array) -> tuple[Array, Array]:
        return balanced(*self._raw(y))

    def _raw(self, y: Array) -> tuple[Array, Array]:
        """F and DF without row scaling."""
        n = self.family.size
        f, jacobian, slope = self.family.linear((y * self.scale)[:n], y[n] * self.scale[n])
        return f, np.column_stack([jacobian.reshape(n, n), slope]) * self.scale

    def unscaled(self, y: Array) -> tuple[Array, float]:
        """State [n] and parameter of a scaled point."""
        z = y * self.scale
        return z[:-1], float(z[-1])

    def scaled(self, state: Array, value: float) -> Array:
        """The scaled point of a state [n] and a parameter."""
        return np.asarray(np.append(state, value) / self.scale)

    def eigenvalues(self, y: Array) -> ComplexArray:
        """Eigenvalues of the Jacobian (with delays characteristic roots), by decreasing real part."""
        state, value = self.unscaled(y)
        n = self.family.size
        if self.family.system.delayed is not None:
            return self.family.at(value).spectrum(state)
        return ordered_eigenvalues(self.family.linear(state, value)[1].reshape(n, n))

    def steady_point(self, y: Array) -> SteadyPoint:
        """The point in the user's units."""
        state, value = self.unscaled(y)
        return SteadyPoint(value, state, self.eigenvalues(y), self.family.at(value).outside(state))

    def solve(self, state: Array, value: float) -> Array | None:
        """The scaled steady state near `state` at exactly this value of the parameter."""
        normal = np.zeros(len(self.scale))
        normal[-1] = 1.0
        corrected = self.curve.correct(self.scaled(state, value), normal, iterations=15)
        return None if corrected is None else corrected[0]

    def start(self, state: Array, value: float, forward: bool) -> CurvePoint | None:
        """The first point of a continuation, with its tangent towards larger (or smaller) values of the parameter."""
        y = self.solve(state, value)
        if y is None:
            return None
        derivative = self._evaluate(y)[1]
        tangent = np.linalg.svd(derivative)[2][-1]
        sign = 1.0 if (tangent[-1] >= 0.0) == forward else -1.0
        return CurvePoint(y, sign * tangent, derivative)

    # ------------------------------------------------------------------ following
    def follow(self, start: CurvePoint, most: int = 4000) -> Followed:
        """Follows the curve from a point along its tangent; the result states why it ended."""
        result = Followed([start])
        before, turned = start, [False, False]
        unstable = self._unstable(start)
        for point, length in self.curve.walk(start, self.steps, corners=True):
            value = self.unscaled(point.y)[1]
            outside = value < self.low or value > self.high
            if outside:
                last = self._at_end(before, self.low if value < self.low else self.high)
                if last is None:  # as where branches cross at the end of the range
                    result.end = "no point found at the end of the range"
                    return result
                length, point = float((last.y - before.y) @ before.tangent), last
            now = self._unstable(point)
            result.special.extend(self._changes(before, point, length, unstable, now))
            result.points.append(point)
            # A start on a corner has the tangent of neither side: the curve comes back to the point beyond it.
            for i, one in enumerate(result.points[:2]):
                turned[i] = turned[i] or bool(point.tangent @ one.tangent < 0.0)  # as any closed curve does somewhere
                if turned[i] and not outside and self._back_at(one, point):  # the last step ends where the first began
                    beyond = i == 1 or (point.y - start.y) @ start.tangent > 0.0
                    result.points[-1 if beyond else len(result.points) :] = [start]
                    result.end = "closed"
                    return result
            result.end = "range" if outside else self._reason_to_stop(point, len(result.points), most)
            if result.end:
                return result
            before, unstable = point, now
        result.end = "no step converged"
        return result

    def _at_end(self, before: CurvePoint, value: float) -> CurvePoint | None:
        """The curve's point at an end of the range."""
        drop = (value / self.scale[-1] - before.y[-1]) / before.tangent[-1] if before.tangent[-1] else 0.0
        y = self.solve((before.y + drop * before.tangent)[:-1] * self.scale[:-1], value)
        if y is None or np.max(np.abs(y - before.y)) > 3.0 * self.steps.most:
            return None
        derivative = self._evaluate(y)[1]
        tangent = self.curve.tangent(derivative, before.tangent)
        return None if tangent is None else CurvePoint(y, tangent, derivative)

    def _back_at(self, earlier: CurvePoint, point: CurvePoint) -> bool:
        """Whether the curve has come back to an earlier point, to within a step."""
        apart = point.y - earlier.y
        if np.max(np.abs(apart)) >= self.steps.most or point.tangent @ earlier.tangent <= 0.9:
            return False
        along = float(apart @ earlier.tangent) * earlier.tangent
        return bool(np.linalg.norm(apart - along) < 0.1 * self.steps.most)

    def _reason_to_stop(self, point: CurvePoint, count: int, most: int) -> str:
        state, _ = self.unscaled(point.y)
        if not self.family.system.admissible(state):
            return "a state falls below its range"
        if np.any(state < self._far[0]) or np.any(state > self._far[1]):
            return "a state moves far outside its range"
        return "number of points" if count >= most else ""

    # ------------------------------------------------------------------ special points
    def _unstable(self, point: CurvePoint) -> int:
        """The number of eigenvalues to the right of the imaginary axis.

        Those on it up to rounding do not count: along a curve of centres (prey and predators) only their signs change.
        """
        eigenvalues = self.eigenvalues(point.y)
        return int(np.sum(eigenvalues.real > axis_width(eigenvalues)))

    def _changes(
        self, a: CurvePoint, b: CurvePoint, length: float, before: int, after: int
    ) -> list[tuple[Kind, CurvePoint]]:
        """The special points within one step."""
        found: list[tuple[Kind, CurvePoint]] = []
        if a.tangent @ b.tangent < self.steps.turn:  # around a corner, next to which a lies
            return [("nonsmooth_fold", _corner(a, b))] if a.tangent[-1] * b.tangent[-1] < 0.0 else []
        if a.tangent[-1] * b.tangent[-1] < 0.0:
            fold = self.curve.locate(a, length, lambda point: float(point.tangent[-1]))
            # Where several branches cross, one that turns there has no fold of its own.
            if fold is not None and not singular(self._raw, fold.y):
                found.append(("fold", fold))
        sign_a, _ = np.linalg.slogdet(np.vstack([a.derivative, a.tangent]))
        sign_b, _ = np.linalg.slogdet(np.vstack([b.derivative, b.tangent]))
        if sign_a * sign_b < 0:
            self._add(found, "branch", branch_point(self._raw, a, b) or self._crossing_at_corner(a, b, length))
        if abs(after - before) >= 2:
            rank = min(before, after)
            located = self.curve.locate(a, length, lambda point: float(self._eigenvalue(point, rank).real))
            if located is not None and abs(self._eigenvalue(located, rank).imag) > 1e-7:
                self._add(found, "hopf", located)
        return found

    def _crossing_at_corner(self, a: CurvePoint, b: CurvePoint, length: float) -> CurvePoint | None:
        """The branch point between neighbours where branches cross at a corner, at which DF has no derivatives."""

        def bordered(point: CurvePoint) -> float:
            return float(np.linalg.det(np.vstack([point.derivative, point.tangent])))

        located = self.curve.locate(a, length, bordered)
        if located is None:
            return None
        sizes = np.maximum(*(row_sizes(self._raw(point.y)[1]) for point in (a, b)))
        before, after = (self._raw(located.y + by * a.tangent)[1] for by in (-BEYOND, BEYOND))
        jump = np.max(np.abs(after - before) / sizes[:, None])
        return located if jump > JUMP else None

    def _eigenvalue(self, point: CurvePoint, rank: int) -> complex:
        """The eigenvalue of a rank; the last one where fewer characteristic roots are known."""
        eigenvalues = self.eigenvalues(point.y)
        return complex(eigenvalues[min(rank, len(eigenvalues) - 1)])

    @staticmethod
    def _add(found: list[tuple[Kind, CurvePoint]], kind: Kind, point: CurvePoint | None) -> None:
        if point is not None:
            found.append((kind, point))

    # ------------------------------------------------------------------ other branches
    def crossing_tangents(self, at: CurvePoint) -> list[Array]:
        """Unit tangents of the branches through a branch point, without that of the branch on which it was found."""
        tangents = crossing_tangents(self._raw, at.y)
        tangents.sort(key=lambda one: abs(float(one @ at.tangent)))
        return tangents[:1] if at.tangent.any() else tangents

    def crossing(self, start: CurvePoint) -> CurvePoint | None:
        """The branch point at `start`, without a tangent; None if it is a regular point."""
        at = branch_point_at(self._raw, start.y)
        if at is None:
            return None
        tangents = crossing_tangents(self._raw, at.y)
        there = [any(self.switch(at, sign * one) is not None for sign in (1.0, -1.0)) for one in tangents]
        return at if there and all(there) else None

    def switch(self, at: CurvePoint, tangent: Array) -> CurvePoint | None:
        """A point on the branch through a branch point in the direction `tangent`."""
        length = 5e-3
        while length > 1e-5:
            point = self.curve.point(at.y + length * tangent, tangent)
            if point is not None and abs(point.tangent @ tangent) > 0.9:
                return point
            length /= 3.0
        return None


def _corner(a: CurvePoint, b: CurvePoint) -> CurvePoint:
    """Where the tangents at points just before and just behind a corner meet."""
    along = np.linalg.lstsq(np.column_stack([a.tangent, b.tangent]), b.y - a.y)[0]
    return CurvePoint(a.y + along[0] * a.tangent, a.tangent, a.derivative)
