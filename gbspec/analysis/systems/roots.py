"""Characteristic roots of systems with delays, by a spectral discretisation of the infinitesimal generator.

The solution over the longest delay is replaced by its values at Chebyshev points: at all of them but the present one it
is transported, its rate is its derivative; at the present one it is that of the linearised equations, with delayed
values by barycentric interpolation. The eigenvalues of this matrix converge to the rightmost roots faster than any
power of the number of points (Breda, Maset, Vermiglio 2005, SIAM J. Sci. Comput. 27:482).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array, ComplexArray

POINTS = 32
"""Intervals between the points at first; doubled until the roots do not change any more."""
MOST_POINTS = 256
SAME = 1e-8
"""Roots agree if they differ by less than this, relative to the largest."""
KEPT = 8
"""The number of rightmost roots that are given (at least the number of states)."""


def ordered_eigenvalues(jacobian: Array) -> ComplexArray:
    """Eigenvalues by decreasing real part; in a pair, the positive imaginary part first."""
    values = np.linalg.eigvals(jacobian).astype(complex)
    return values[order_of(values)]


def ordered_modes(jacobian: Array) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues [n] in the order of `eigenvalues`, and unit eigenvectors, the columns of [n, n]."""
    values, vectors = np.linalg.eig(jacobian)
    order = order_of(values)
    return values[order].astype(complex), vectors[:, order].astype(complex)


def order_of(values: ComplexArray) -> NDArray[np.intp]:
    """The order of eigenvalues by decreasing real part; in a pair, the positive imaginary part first."""
    # Rounding the key keeps pairs together, whose real parts may differ in the last bit.
    size = float(np.abs(values).max()) or 1.0
    return np.lexsort((-values.imag, -np.round(values.real / size, 12)))


def characteristic_modes(now: Array, late: Sequence[Array], lags: Array) -> tuple[ComplexArray, ComplexArray]:
    """The rightmost roots [K] of x' = now x + sum of late_i x(t - lag_i), by decreasing real part, in a pair the
    positive imaginary part first, and their modes at the present, the unit columns of [n, K]."""
    kept = max(KEPT, len(now))
    count = POINTS
    values, vectors = _modes(now, late, lags, count, kept)
    while count < MOST_POINTS:
        count *= 2
        finer, vectors = _modes(now, late, lags, count, kept)
        size = float(np.abs(finer).max()) or 1.0
        done = bool(np.abs(np.sort_complex(finer) - np.sort_complex(values)).max() <= SAME * size)
        values = finer
        if done:
            break
    return values, vectors


def _modes(now: Array, late: Sequence[Array], lags: Array, count: int, kept: int) -> tuple[ComplexArray, ComplexArray]:
    n, longest = len(now), float(np.max(lags))
    nodes, weights, derivative = _chebyshev(count)
    generator = np.kron(derivative * (2.0 / longest), np.eye(n))
    generator[:n] = 0.0
    generator[:n, :n] = now
    for matrix, lag in zip(late, lags, strict=True):
        generator[:n] += np.kron(_interpolation(nodes, weights, 1.0 - 2.0 * lag / longest), matrix)
    values, vectors = np.linalg.eig(generator)
    size = float(np.abs(values[np.argsort(-values.real)[:kept]]).max()) or 1.0
    order = np.lexsort((-values.imag, -np.round(values.real / size, 11)))[:kept]
    present = np.asarray(vectors[:n, order], dtype=np.complex128)
    lengths = np.linalg.norm(present, axis=0)
    unit = present / np.where(lengths > 0, lengths, 1.0)
    return np.asarray(values[order], dtype=np.complex128), np.asarray(unit, dtype=np.complex128)


def _chebyshev(count: int) -> tuple[Array, Array, Array]:
    """Chebyshev points from 1 to -1, their barycentric weights, and the matrix of the derivative (Trefethen 2000,
    Spectral Methods in MATLAB, ch. 6)."""
    j = np.arange(count + 1)
    nodes: Array = np.cos(np.pi * j / count)
    weights: Array = np.where(j % 2 == 0, 1.0, -1.0)
    weights[[0, -1]] *= 0.5
    apart = nodes[:, None] - nodes + np.eye(count + 1)
    matrix: Array = weights / weights[:, None] / apart
    matrix -= np.diag(matrix.sum(axis=1))
    return nodes, weights, matrix


def _interpolation(nodes: Array, weights: Array, at: float) -> Array:
    """The values at the nodes [1, N + 1] in the value of their polynomial at a point."""
    apart = at - nodes
    near = int(np.argmin(np.abs(apart)))
    if abs(apart[near]) < 1e-14:
        return np.eye(len(nodes))[near : near + 1]
    parts = weights / apart
    return np.asarray((parts / parts.sum())[None])
