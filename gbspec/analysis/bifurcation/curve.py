"""Pseudo-arclength continuation of a curve F(y) = 0, F: R^(m+1) -> R^m (Keller 1977; Allgower and Georg, ch. 6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array

TOLERANCE = 1e-11
"""Newton stops when its step is below this, in scaled variables."""

ROUNDING = 1e-9
"""A test at one end of a step that is this small, relative to its other end, is zero."""

BEYOND = 1e-6
"""How far beyond a corner the curve is taken up again, in scaled variables: many of the shortest steps."""


@dataclass(frozen=True)
class CurvePoint:
    """A point y [m+1] of the curve, its unit tangent [m+1] and the derivative DF [m, m+1] there."""

    y: Array
    tangent: Array
    derivative: Array


@dataclass(frozen=True)
class Steps:
    """Bounds on step lengths along the curve, in scaled variables, and on the rotation of the tangent in one step."""

    first: float = 0.005
    least: float = 1e-8
    most: float = 0.02
    turn: float = 0.99
    """Smallest cosine between the tangents of neighbouring points."""


def row_sizes(derivative: Array) -> Array:
    """The largest absolute entry [m] of each row of DF [m, m+1], for row scaling."""
    return np.asarray(np.maximum(np.abs(derivative).max(axis=1), 1e-300))


def balanced(f: Array, derivative: Array) -> tuple[Array, Array]:
    """F [m] and DF [m, m+1] with rows scaled to equal size, so that no fast state dominates Newton's tolerance."""
    sizes = row_sizes(derivative)
    return f / sizes, derivative / sizes[:, None]


class Curve:
    """The zero set of F, given as y -> (F [m], DF [m, m+1]) in variables scaled to be of the order of one."""

    def __init__(self, evaluate: Callable[[Array], tuple[Array, Array]]) -> None:
        self.evaluate = evaluate

    def tangent(self, derivative: Array, along: Array) -> Array | None:
        """The unit null vector of `derivative` [m, m+1] that points along `along` [m+1]; None if it is not unique."""
        right = np.zeros(len(along))
        right[-1] = 1.0
        try:
            vector = np.linalg.solve(np.vstack([derivative, along]), right)
        except np.linalg.LinAlgError:
            return None
        size = float(np.linalg.norm(vector))
        return np.asarray(vector / size, dtype=float) if np.isfinite(size) and size > 0 else None

    def correct(self, guess: Array, normal: Array, iterations: int = 8) -> tuple[Array, Array, int] | None:
        """Newton's method from `guess` in the hyperplane through it with this normal: y, DF there, and iterations."""
        y = guess.copy()
        for iteration in range(1, iterations + 1):
            f, derivative = self.evaluate(y)
            if not (np.isfinite(f).all() and np.isfinite(derivative).all()):
                return None
            try:
                step = np.linalg.solve(np.vstack([derivative, normal]), np.append(f, normal @ (y - guess)))
            except np.linalg.LinAlgError:
                return None
            y = y - step
            size = float(np.max(np.abs(step)))
            if not np.isfinite(size) or size > 1e3:
                return None
            if size < TOLERANCE:
                return y, self.evaluate(y)[1], iteration
        return None

    def point(self, guess: Array, along: Array) -> CurvePoint | None:
        """The point of the curve near `guess` in the hyperplane orthogonal to `along`, with its tangent."""
        corrected = self.correct(guess, along)
        if corrected is None:
            return None
        y, derivative, _ = corrected
        tangent = self.tangent(derivative, along)
        return None if tangent is None else CurvePoint(y, tangent, derivative)

    def walk(self, start: CurvePoint, steps: Steps, *, corners: bool = False) -> Iterator[tuple[CurvePoint, float]]:
        """Yields points after `start` along its tangent, each with its step length, until no step converges; with
        `corners` it goes on around those where DF jumps, as at `abs` or `max`."""
        here, length = start, steps.first
        while True:
            guess = here.y + length * here.tangent
            corrected = self.correct(guess, here.tangent)
            if corrected is not None and np.linalg.norm(corrected[0] - guess) > length:  # of another branch
                corrected = None
            tangent = None if corrected is None else self.tangent(corrected[1], here.tangent)
            if corrected is None or tangent is None or tangent @ here.tangent < steps.turn:
                length /= 2.0
                if length < steps.least:
                    beyond = self._around(here, steps) if corners else None
                    if beyond is None:
                        return
                    yield beyond, BEYOND
                    here, length = beyond, steps.first
                continue
            y, derivative, iterations = corrected
            here = CurvePoint(y, tangent, derivative)
            yield here, length
            if iterations <= 4:
                length = min(steps.most, 1.5 * length)
            elif iterations > 6:
                length /= 2.0

    def _around(self, here: CurvePoint, steps: Steps) -> CurvePoint | None:
        """The curve's point just beyond a corner next to `here`; None if there is no corner.

        Across it DF changes by a matrix of rank one, whose rows are multiples of the normal of the surface on which it
        jumps. So det [DF; tangent] keeps its sign for tangents that both point across this surface.
        """
        derivative = self.evaluate(here.y + BEYOND * here.tangent)[1]
        if not np.isfinite(derivative).all():
            return None
        tangent = np.linalg.svd(derivative)[2][-1]
        before, after = (
            np.linalg.slogdet(np.vstack([matrix, along]))[0]
            for matrix, along in ((here.derivative, here.tangent), (derivative, tangent))
        )
        tangent = tangent * (before * after)
        if before * after == 0.0 or tangent @ here.tangent >= steps.turn:
            return None
        point = self.point(here.y + BEYOND * tangent, tangent)
        if point is None or np.max(np.abs(point.y - here.y)) > 10.0 * BEYOND:  # F itself jumps
            return None
        return point if point.tangent @ tangent >= steps.turn else None

    def locate(
        self, a: CurvePoint, length: float, test: Callable[[CurvePoint], float], tolerance: float = 1e-13
    ) -> CurvePoint | None:
        """The zero of `test` within the step of this length from `a`, by Brent's method along the curve.

        An end where the test is zero up to rounding counts; None if it has one sign at both ends.
        """
        from scipy.optimize import brentq

        seen: dict[float, CurvePoint] = {}

        def value(s: float) -> float:
            point = self.point(a.y + s * a.tangent, a.tangent) if s > 0.0 else a
            if point is None:
                raise ArithmeticError
            seen[s] = point
            return test(point)

        try:
            first, last = value(0.0), value(length)
            if first * last > 0.0:
                size = ROUNDING * max(abs(first), abs(last))
                return seen[0.0] if abs(first) <= size else seen[length] if abs(last) <= size else None
            s = float(brentq(value, 0.0, length, xtol=tolerance * max(length, 1.0), rtol=1e-15, maxiter=80))
            return seen[s] if s in seen else self.point(a.y + s * a.tangent, a.tangent)
        except ArithmeticError:
            return None
