"""Characteristic roots of systems with delays, by a spectral discretisation of the infinitesimal generator.

The solution over the longest delay is replaced by its values at Chebyshev points: at all of them but the present one it
is transported, its rate is its derivative; at the present one it is that of the linearised equations, with delayed
values by barycentric interpolation. The eigenvalues of this matrix converge to the rightmost roots faster than any
power of the number of points (Breda, Maset, Vermiglio 2005, SIAM J. Sci. Comput. 27:482); those that have not converged
are no roots at all, and are told by Newton's method on the characteristic matrix. Only delays inside a loop of states
have such roots: the equations are first divided into the loops.
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
"""The number of rightmost roots that are given (at least the number of states, and never one of a pair alone)."""
REACH = 1.0
"""Newton's method may move a root by this much over the longest delay; the imaginary parts of roots are 2 pi apart."""
TOGETHER = 1e-4
"""Eigenvalues that become the same root are a multiple one if each was this close to it (relative), else one of them is
none."""
EXACT = 1e-10
"""A root's characteristic matrix is singular to this part of the sum of its terms."""
LARGEST = 600.0
"""Largest exponent of a delayed term; a root needs no larger one."""


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
    # Rounding the keys keeps pairs together, whose real parts may differ in the last bit.
    size = float(np.abs(values).max(initial=0.0)) or 1.0
    return np.lexsort((-values.imag, -np.round(np.abs(values.imag) / size, 12), -np.round(values.real / size, 12)))


def characteristic_modes(now: Array, late: Sequence[Array], lags: Array) -> tuple[ComplexArray, ComplexArray]:
    """The rightmost roots [K] of x' = now x + sum of late_i x(t - lag_i), by decreasing real part, in a pair the
    positive imaginary part first, and their modes at the present, the unit columns of [n, K].

    Each is a root of the characteristic equation to rounding, a multiple one to a part of the digits. Where no delayed
    term is in a loop, they are eigenvalues.
    """
    from scipy.sparse.csgraph import connected_components

    kept = max(KEPT, len(now))
    links = np.any([part != 0 for part in (now, *late)], axis=0)
    loops = connected_components(links, directed=True, connection="strong")[1]
    found: list[ComplexArray] = []
    for loop in range(int(loops.max()) + 1):
        mine = np.ix_(loops == loop, loops == loop)
        inside = [(part[mine], float(lag)) for part, lag in zip(late, lags, strict=True) if part[mine].any()]
        found.append(_roots(now[mine], inside, kept) if inside else np.linalg.eigvals(now[mine]).astype(complex))
    roots = _first(np.concatenate(found), kept)
    terms = list(zip(late, map(float, lags), strict=True))
    modes = [
        _null_vector(now, terms, root, int(np.sum(np.abs(roots[:i] - root) <= SAME * abs(root))))
        for i, root in enumerate(roots)
    ]
    return roots, np.array(modes, dtype=np.complex128).reshape(len(roots), len(now)).T


Terms = Sequence[tuple[Array, float]]
"""Matrices of delayed states, each with its delay."""


def _first(roots: ComplexArray, kept: int) -> ComplexArray:
    """The first `kept` roots in their order, and the other one of a pair."""
    roots = roots[order_of(roots)]
    while kept < len(roots) and np.sign(roots[:kept].imag).sum() != 0:
        kept += 1
    return roots[:kept]


def _roots(now: Array, late: Terms, kept: int) -> ComplexArray:
    """The rightmost roots of one loop, with all of its delays."""
    count = POINTS
    values = _verified(now, late, count, kept)
    while count < MOST_POINTS:
        count *= 2
        finer = _verified(now, late, count, kept)
        size = float(np.abs(finer).max(initial=0.0)) or 1.0
        done = len(finer) == len(values) and bool(np.abs(finer - values).max(initial=0.0) <= SAME * size)
        values = finer
        if done:
            break
    return values


def _verified(now: Array, late: Terms, count: int, kept: int) -> ComplexArray:
    """The rightmost roots near eigenvalues of the discretisation with `count` intervals."""
    longest = max(lag for _, lag in late)
    values = np.linalg.eigvals(_generator(now, late, count)).astype(complex)
    values = values[order_of(values)]
    roots: list[complex] = []
    origins: list[complex] = []
    for value in map(complex, values[values.imag >= 0]):
        if len(roots) + sum(root.imag > 0 for root in roots) >= kept:
            break
        root = _polished(now, late, value)
        if root is None or abs(root - value) > REACH / longest:
            continue
        near = TOGETHER * max(abs(root), 1.0 / longest)
        if root.imag < -near or any(
            abs(one - root) <= near and max(abs(origin - root), abs(value - root)) > near
            for one, origin in zip(roots, origins, strict=True)
        ):
            continue
        roots.append(complex(root.real, abs(root.imag)))
        origins.append(value)
    return _first(np.array([*roots, *(root.conjugate() for root in roots if root.imag > 0)], dtype=complex), kept)


def _polished(now: Array, late: Terms, value: complex) -> complex | None:
    """The root that Newton's method on the characteristic matrix reaches, None if it reaches none."""
    longest = max(lag for _, lag in late)
    root = value
    if not -root.real * longest < LARGEST:
        return None
    matrix = _characteristic(now, late, root)[0]
    # A real root stays real: its matrix is, and so is its vector.
    normal = np.linalg.svd(matrix if value.imag else matrix.real)[2][-1]
    vector = normal.conj()
    for _ in range(20):
        matrix, slope, _ = _characteristic(now, late, root)
        bordered = np.block([[matrix, (slope @ vector)[:, None]], [normal[None], np.zeros((1, 1))]])
        right_side = np.append(-(matrix @ vector), 1.0 - normal @ vector)
        step = np.linalg.lstsq(bordered, right_side, rcond=None)[0]
        vector, root = vector + step[:-1], complex(root + step[-1])
        if not (np.isfinite(root) and -root.real * longest < LARGEST):
            return None
        if abs(step[-1]) <= 1e-15 * max(abs(root), 1.0 / longest):
            break
    matrix, _, sizes = _characteristic(now, late, root)
    return root if float(np.linalg.svd(matrix, compute_uv=False)[-1]) <= EXACT * sizes.max() else None


def _characteristic(now: Array, late: Terms, root: complex) -> tuple[ComplexArray, ComplexArray, Array]:
    """The characteristic matrix root - now - sum of late_i exp(-root lag_i), its derivative, and the sums of the sizes
    of its terms in each row."""
    unit = np.eye(len(now))
    matrix, slope = root * unit - now, unit.astype(complex)
    sizes = abs(root) + np.abs(now).sum(axis=1)
    for part, lag in late:
        term = part * np.exp(complex(min(-root.real * lag, LARGEST), -root.imag * lag))
        matrix, slope = matrix - term, slope + lag * term
        sizes = sizes + np.abs(term).sum(axis=1)
    return np.asarray(matrix, dtype=np.complex128), slope, np.asarray(sizes)


def _null_vector(now: Array, late: Terms, root: complex, earlier: int) -> ComplexArray:
    """The unit vector that a root's matrix takes nearest to zero, rows being equally large; of a multiple root, that
    orthogonal to those of `earlier` ones if there is one."""
    matrix, _, sizes = _characteristic(now, late, root)
    _, values, vectors = np.linalg.svd(matrix / np.where(sizes > 0, sizes, 1.0)[:, None])
    chosen = -1 - earlier if earlier < len(values) and values[-1 - earlier] <= SAME else -1
    return np.asarray(vectors[chosen].conj(), dtype=np.complex128)


def _generator(now: Array, late: Terms, count: int) -> Array:
    """The matrix of the discretisation over the longest delay, with `count` intervals."""
    n, longest = len(now), max(lag for _, lag in late)
    nodes, weights, derivative = _chebyshev(count)
    generator = np.zeros(((count + 1) * n, (count + 1) * n))
    generator[:] = np.kron(derivative * (2.0 / longest), np.eye(n))
    generator[:n] = 0.0
    generator[:n, :n] = now
    for matrix, lag in late:
        generator[:n] += np.kron(_interpolation(nodes, weights, 1.0 - 2.0 * lag / longest), matrix)
    return generator


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
