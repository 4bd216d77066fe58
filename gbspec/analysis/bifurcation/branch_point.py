"""Branch points of a curve F(y) = 0, where Newton's method along it is singular, and the branches that cross there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.analysis.bifurcation.curve import CurvePoint, row_sizes
from gbspec.arrays import Array

STEP = 1e-5
"""The step of central differences of DF, in scaled variables."""
CONVERGED = 1e-10
"""The correction at which the point counts as found, in scaled variables."""
ON_CURVE = 1e-8
"""How little the equations may have to be shifted for the two branches to meet: else they pass each other."""

SINGULAR = 1e-7
"""The smallest singular value of DF, its rows of size one, below which a point may be a branch point."""
AT = 1e-5
"""How far a branch point may be from the point at which a search hit it."""
FLAT = 1e-7
"""Second derivatives below this are rounding: the equations are dependent, and steady states form a surface."""
AROUND = 0.01
"""Rows are measured at the branch point and this far from it, in scaled variables."""

Raw = Callable[[Array], tuple[Array, Array]]
"""y -> (F [m], DF [m, m+1]) without row scaling."""


def branch_point(evaluate: Raw, a: CurvePoint, b: CurvePoint) -> CurvePoint | None:
    """The branch point between neighbours on a curve, with the tangent of their branch; None if none is found there.

    Close to it two branches meet each hyperplane, and Newton's method along the curve fails. The extended system
    F + beta psi = 0, DF' psi = 0, psi' psi = 1 for (y, beta, psi) is regular at a simple branch point, where beta = 0
    (Moore, SIAM J. Numer. Anal. 17, 1980); second derivatives are central differences of the exact DF.
    """
    scaled = _scaled(evaluate, a.y)
    # The determinant bordered by the tangent is zero at the branch point: a first guess by interpolation.
    ends = [float(np.linalg.det(np.vstack([scaled(point.y)[1], point.tangent]))) for point in (a, b)]
    part = ends[0] / (ends[0] - ends[1]) if ends[0] != ends[1] else 0.5
    guess = a.y + part * (b.y - a.y)
    found = _extended(scaled, guess)
    if found is None or np.linalg.norm(found - guess) > np.linalg.norm(b.y - a.y):
        return None
    tangent = (1.0 - part) * a.tangent + part * b.tangent
    return CurvePoint(found, tangent / np.linalg.norm(tangent), scaled(found)[1])


def branch_point_at(evaluate: Raw, y: Array) -> CurvePoint | None:
    """The branch point at a point of the curve, which a search may hit; None if that is a regular point.

    Its tangent is zero: two branches continue, along both `crossing_tangents`.
    """
    if not singular(evaluate, y):
        return None
    scaled = _scaled(evaluate, y)
    found = _extended(scaled, y)
    if found is None or np.max(np.abs(found - y)) > AT:
        return None
    return CurvePoint(found, np.zeros_like(found), scaled(found)[1])


def singular(evaluate: Raw, y: Array) -> bool:
    """Whether the curve has no unique tangent at y, as at branch points, simple or degenerate; at a fold it has one."""
    return bool(np.linalg.svd(_scaled(evaluate, y)(y)[1], compute_uv=False)[-1] <= SINGULAR)


def crossing_tangents(evaluate: Raw, y: Array) -> list[Array]:
    """Unit tangents of the two branches through a branch point; none where no two branches cross.

    They solve the algebraic branching equation a r^2 + 2 b r s + c s^2 = 0 on the two-dimensional null space of
    DF (Kuznetsov, section 10.2.4), second derivatives by central differences of the exact DF.
    """
    scaled = _scaled(evaluate, y)
    left, _, right = np.linalg.svd(scaled(y)[1])
    psi, null = left[:, -1], right[-2:]

    def second(direction: Array) -> Array:
        return np.asarray(scaled(y + STEP * direction)[1] - scaled(y - STEP * direction)[1]) / (2.0 * STEP)

    form = np.array([[psi @ second(u) @ v for v in null] for u in null])
    a, b, c = form[0, 0], (form[0, 1] + form[1, 0]) / 2.0, form[1, 1]
    size = max(abs(a), abs(b), abs(c))
    discriminant = b * b - a * c
    if size < FLAT or discriminant <= FLAT * size**2:
        return []
    root = np.sqrt(discriminant)
    if abs(a) > 1e-9 * size:
        ratios = [((-b + root) / a, 1.0), ((-b - root) / a, 1.0)]
    else:
        ratios = [(1.0, 0.0), (-c / (2.0 * b), 1.0)]
    tangents = [r * null[0] + s * null[1] for r, s in ratios]
    return [tangent / np.linalg.norm(tangent) for tangent in tangents]


def _scaled(evaluate: Raw, y: Array) -> Raw:
    """F and DF with rows of equal size around y; at y itself a row may vanish, as in x' = r x - x^2 at 0."""
    sizes = row_sizes(np.hstack([evaluate(y)[1], evaluate(y + AROUND)[1]]))

    def scaled(z: Array) -> tuple[Array, Array]:
        f, derivative = evaluate(z)
        return f / sizes, derivative / sizes[:, None]

    return scaled


def _extended(scaled: Raw, y: Array) -> Array | None:
    """Newton's method for the extended system from a guess y [m+1]."""
    m = len(y) - 1
    psi, beta = np.linalg.svd(scaled(y)[1])[0][:, -1], 0.0
    unit = STEP * np.eye(m + 1)
    for _ in range(12):
        f, derivative = scaled(y)
        bend = np.array([(scaled(y + h)[1] - scaled(y - h)[1]).T @ psi for h in unit]).T / (2.0 * STEP)
        matrix = np.zeros((2 * m + 2, 2 * m + 2))
        matrix[:m, : m + 1], matrix[:m, m + 1], matrix[:m, m + 2 :] = derivative, psi, beta * np.eye(m)
        matrix[m : 2 * m + 1, : m + 1], matrix[m : 2 * m + 1, m + 2 :] = bend, derivative.T
        matrix[-1, m + 2 :] = 2.0 * psi
        right = np.concatenate([f + beta * psi, derivative.T @ psi, [psi @ psi - 1.0]])
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            return None
        try:
            step = np.linalg.solve(matrix, right)
        except np.linalg.LinAlgError:
            return None
        y, beta, psi = y - step[: m + 1], beta - step[m + 1], psi - step[m + 2 :]
        if np.max(np.abs(step)) < CONVERGED:
            return y if abs(beta) < ON_CURVE else None
    return None
