"""Periodic orbits as boundary value problems: orthogonal collocation at Gauss points on an adaptive mesh.

On each of N mesh intervals of s = t/T in [0, 1] the orbit is a polynomial of degree m through m + 1 equidistant nodes
and satisfies x' = T f(x, p) at the m Gauss points, as in AUTO and COLSYS (de Boor and Swartz, SIAM J. Numer. Anal. 10,
1973; Doedel, Keller and Kernevez, Int. J. Bifurcation Chaos 1, 1991). Nodes inside the intervals are eliminated, which
leaves the transfer matrix G_j of every interval: the product of the G_j is the monodromy matrix.

All states are scaled (divided by `scale`), the period enters as log T and the parameter as p/width, so that one step
length means the same for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from gbspec.analysis.systems import Family
from gbspec.arrays import Array, ComplexArray

DEGREE = 4


@dataclass(frozen=True)
class Basis:
    """Lagrange polynomials on the nodes k/m: values and derivatives [m, m+1] at the Gauss points, and weights [m]."""

    values: Array
    derivatives: Array
    weights: Array
    points: Array
    leading: Array
    """Coefficients [m+1] that give the m-th derivative from the nodes' values."""


@cache
def basis(degree: int) -> Basis:
    """The basis of one degree."""
    points, weights = np.polynomial.legendre.leggauss(degree)
    points, weights = (points + 1.0) / 2.0, weights / 2.0
    values, derivatives = lagrange(degree, points)
    nodes = np.arange(degree + 1) / degree
    leading = np.array(
        [np.prod([1.0 / (nodes[k] - other) for i, other in enumerate(nodes) if i != k]) for k in range(degree + 1)]
    )
    return Basis(values, derivatives, weights, points, leading * float(np.prod(np.arange(1, degree + 1))))


def lagrange(degree: int, points: Array) -> tuple[Array, Array]:
    """Values and derivatives [P, m+1] of the Lagrange polynomials on the nodes k/m at `points` [P] of [0, 1]."""
    nodes = np.arange(degree + 1) / degree
    inverse = np.linalg.inv(np.vander(nodes, increasing=True))
    powers = np.vander(points, degree + 1, increasing=True)
    slopes = np.zeros_like(powers)
    slopes[:, 1:] = powers[:, :-1] * np.arange(1, degree + 1)
    return powers @ inverse, slopes @ inverse


@dataclass(frozen=True)
class Orbit:
    """A closed polynomial curve in scaled variables: `mesh` [N+1] of [0, 1], nodes [N*m, n] (the last is the first)."""

    mesh: Array
    nodes: Array
    log_period: float
    parameter: float

    @property
    def intervals(self) -> int:
        """Number of mesh intervals N."""
        return len(self.mesh) - 1

    @property
    def local(self) -> Array:
        """The nodes of each interval [N, m+1, n]."""
        return self.nodes[local_indices(self.intervals)]

    def moved(self, step: Orbit, length: float) -> Orbit:
        """This curve plus `length` times a direction on the same mesh."""
        return Orbit(
            self.mesh,
            self.nodes + length * step.nodes,
            self.log_period + length * step.log_period,
            self.parameter + length * step.parameter,
        )

    def at(self, s: Array) -> Array:
        """The curve [P, n] at times s [P] of [0, 1], in scaled variables."""
        interval = np.clip(np.searchsorted(self.mesh, s, side="right") - 1, 0, self.intervals - 1)
        part = (s - self.mesh[interval]) / np.diff(self.mesh)[interval]
        values, _ = lagrange(DEGREE, part)
        return np.asarray(np.einsum("pk,pkn->pn", values, self.local[interval]))

    def twice(self) -> Orbit:
        """The same curve passed twice, as one of twice the period."""
        mesh = np.concatenate([self.mesh / 2.0, 0.5 + self.mesh[1:] / 2.0])
        return replace(self, mesh=mesh, nodes=np.tile(self.nodes, (2, 1)), log_period=self.log_period + np.log(2.0))

    def remeshed(self, mesh: Array) -> Orbit:
        """The same curve on another mesh."""
        steps = np.diff(mesh)[:, None] * (np.arange(DEGREE) / DEGREE)
        return replace(self, mesh=mesh, nodes=self.at((mesh[:-1, None] + steps).ravel()))


@cache
def local_indices(intervals: int) -> NDArray[np.intp]:
    """Index of every node of every interval [N, m+1]; the last node of the last interval is the first node."""
    index = np.arange(intervals)[:, None] * DEGREE + np.arange(DEGREE + 1)
    return np.asarray(index % (intervals * DEGREE), dtype=np.intp)


def inner(a: Orbit, b: Orbit) -> float:
    """The inner product: the integral of a.b over s, plus the products of log T and of the parameter."""
    form = basis(DEGREE)
    u, v = form.values @ a.local, form.values @ b.local
    integral = np.einsum("i,j,jin,jin->", form.weights, np.diff(a.mesh), u, v)
    return float(integral) + a.log_period * b.log_period + a.parameter * b.parameter


@dataclass(frozen=True)
class Functional:
    """A linear functional of (nodes, log T, parameter): coefficients [N, m+1, n] and two numbers."""

    nodes: Array
    log_period: float = 0.0
    parameter: float = 0.0

    def __call__(self, orbit: Orbit) -> float:
        """Its value."""
        return (
            float(np.sum(self.nodes * orbit.local))
            + self.log_period * orbit.log_period
            + (self.parameter * orbit.parameter)
        )


def along(direction: Orbit) -> Functional:
    """The inner product with a direction."""
    form = basis(DEGREE)
    nodes = np.einsum(
        "i,j,ik,jin->jkn", form.weights, np.diff(direction.mesh), form.values, form.values @ direction.local
    )
    return Functional(nodes, direction.log_period, direction.parameter)


def phase(reference: Orbit) -> Functional:
    """The integral phase condition: the integral of u . d(reference)/ds vanishes for the orbit closest in phase."""
    form = basis(DEGREE)
    slopes = form.derivatives @ reference.local
    return Functional(np.einsum("i,ik,jin->jkn", form.weights, form.values, slopes))


PARAMETER_FIXED = Functional(np.zeros((1, 1, 1)), 0.0, 1.0)
"""Keeps the parameter where it is (its node coefficients broadcast)."""


class Collocation:
    """The collocation equations of a family, for scaled states [n] and parameter `width`."""

    def __init__(self, family: Family, scale: Array, width: float) -> None:
        self.family, self.scale, self.width = family, scale, width
        self.size = family.size

    def linearise(self, orbit: Orbit) -> tuple[Array, Array, Array, Array]:
        """Residuals [N, mn] and their derivatives by local nodes [N, mn, (m+1)n], log T and parameter [N, mn]."""
        form, n, count = basis(DEGREE), self.size, orbit.intervals
        local = orbit.local
        x = (form.values @ local).reshape(-1, n) * self.scale
        f, jacobian, slope = self.family.linear.many(x, [orbit.parameter * self.width])
        span = (np.exp(orbit.log_period) * np.diff(orbit.mesh))[:, None, None]
        f = (f.reshape(count, DEGREE, n) / self.scale) * span
        slope = (slope.reshape(count, DEGREE, n) / self.scale) * (self.width * span)
        jacobian = jacobian.reshape(count, DEGREE, n, n) * (self.scale / self.scale[:, None]) * span[..., None]
        residual = form.derivatives @ local - f
        blocks = np.einsum("ik,ab->iakb", form.derivatives, np.eye(n)) - np.einsum(
            "ik,jiab->jiakb", form.values, jacobian
        )
        rows = DEGREE * n
        return (
            residual.reshape(count, rows),
            blocks.reshape(count, rows, (DEGREE + 1) * n),
            -f.reshape(count, rows),
            -slope.reshape(count, rows),
        )

    def newton_step(
        self, orbit: Orbit, conditions: tuple[Functional, Functional], values: tuple[float, float]
    ) -> Orbit:
        """The change after which the equations vanish to first order, and at which the two functionals are `values`."""
        residual, blocks, by_period, by_parameter = self.linearise(orbit)
        return solve_condensed(orbit, self.size, residual, blocks, by_period, by_parameter, conditions, values)

    def correct(
        self, guess: Orbit, conditions: tuple[Functional, Functional], iterations: int = 10, tolerance: float = 1e-9
    ) -> tuple[Orbit, int] | None:
        """Newton from `guess` with both functionals kept; the orbit and how many iterations, or None."""
        orbit = guess
        targets = [condition(guess) for condition in conditions]
        for iteration in range(1, iterations + 1):
            off = tuple(target - condition(orbit) for target, condition in zip(targets, conditions, strict=True))
            try:
                step = self.newton_step(orbit, conditions, (off[0], off[1]))
            except np.linalg.LinAlgError:
                return None
            size = max(float(np.max(np.abs(step.nodes))), abs(step.log_period), abs(step.parameter))
            if not np.isfinite(size) or size > 10.0:
                return None
            orbit = orbit.moved(step, 1.0)
            if size < tolerance:
                return orbit, iteration
        return None

    def tangent(self, orbit: Orbit, previous: Orbit, conditions: Functional) -> Orbit | None:
        """The unit direction of the curve of orbits, pointing along `previous`."""
        _, blocks, by_period, by_parameter = self.linearise(orbit)
        zero = np.zeros(blocks.shape[:2])
        try:
            step = solve_condensed(
                orbit, self.size, zero, blocks, by_period, by_parameter, (conditions, along(previous)), (0.0, 1.0)
            )
        except np.linalg.LinAlgError:
            return None
        length = np.sqrt(inner(step, step))
        if not np.isfinite(length) or length == 0.0:
            return None
        return replace(
            step, nodes=step.nodes / length, log_period=step.log_period / length, parameter=step.parameter / length
        )

    def multipliers(self, orbit: Orbit) -> ComplexArray:
        """Floquet multipliers by falling modulus; one of them is 1, along the orbit."""
        values = product_eigenvalues(self._responses(orbit)[:, -self.size :, :])
        return values[np.lexsort((-values.imag, -np.round(np.abs(values), 12)))]

    def flip(self, orbit: Orbit) -> Orbit:
        """The unit direction, on the orbit passed twice, of the multiplier closest to -1: it changes sign each time."""
        responses, n = self._responses(orbit), self.size
        monodromy = np.eye(n)
        for matrix in responses[:, -n:, :]:
            monodromy = matrix @ monodromy
        values, vectors = np.linalg.eig(monodromy)
        first = np.real(vectors[:, int(np.argmin(np.abs(values + 1.0)))])
        nodes = []
        for response in responses:
            inside = (response @ first).reshape(DEGREE, n)
            nodes.append(np.vstack([first, inside[:-1]]))
            first = inside[-1]
        once = np.concatenate(nodes)
        direction = Orbit(orbit.twice().mesh, np.concatenate([once, -once]), 0.0, 0.0)
        return replace(direction, nodes=direction.nodes / np.sqrt(inner(direction, direction)))

    def _responses(self, orbit: Orbit) -> Array:
        """How the nodes of every interval but its first follow the first, to first order [N, mn, n]."""
        _, blocks, _, _ = self.linearise(orbit)
        n = self.size
        return np.asarray(-np.linalg.solve(blocks[:, :, n:], blocks[:, :, :n]), dtype=float)


def product_eigenvalues(matrices: Array) -> ComplexArray:
    """Eigenvalues of the product G_N ... G_1 of matrices [N, n, n].

    Where they differ by many orders of magnitude, forming the product loses the small ones in rounding; then they come
    from simultaneous iteration, G_j Q_(j-1) = Q_j R_j around the orbit until the subspaces repeat: diagonal blocks of
    the R_j multiply without mixing.
    """
    product = np.eye(matrices.shape[1])
    for matrix in matrices:
        product = matrix @ product
    values = np.linalg.eigvals(product).astype(complex)
    if np.isfinite(product).all() and float(np.abs(product).max()) < 1e6:
        return values
    start = np.eye(matrices.shape[1])
    for _ in range(12):
        frame, diagonal = start, np.eye(matrices.shape[1])
        for matrix in matrices:
            frame, upper = np.linalg.qr(matrix @ frame)
            diagonal = upper @ diagonal
        turn, start = start.T @ frame, frame
        if np.max(np.abs(np.tril(turn, -1))) < 1e-10:
            break
    return _block_eigenvalues(turn, diagonal)


def _block_eigenvalues(turn: Array, upper: Array) -> ComplexArray:
    """Eigenvalues of turn @ upper, `upper` triangular and `turn` nearly block diagonal with blocks of one or two."""
    values: list[complex] = []
    i, n = 0, len(turn)
    while i < n:
        size = 2 if i + 1 < n and abs(turn[i + 1, i]) > 1e-6 else 1
        block = slice(i, i + size)
        values.extend(map(complex, np.linalg.eigvals(turn[block, block] @ upper[block, block])))
        i += size
    return np.array(values)


def solve_condensed(
    orbit: Orbit,
    n: int,
    residual: Array,
    blocks: Array,
    by_period: Array,
    by_parameter: Array,
    conditions: tuple[Functional, Functional],
    values: tuple[float, float],
) -> Orbit:
    """Solves the bordered collocation system by eliminating the nodes inside the intervals.

    On interval j, B_j d(inner nodes) = -A_j d_j - residual - ...; the last inner node is the next interval's first.
    """
    count = orbit.intervals
    right = np.concatenate(
        [blocks[:, :, :n], residual[..., None], by_period[..., None], by_parameter[..., None]], axis=2
    )
    # Rows: local nodes 1..m; columns: first node, constant, log T, parameter.
    response = -np.linalg.solve(blocks[:, :, n:], right)
    last = response[:, -n:, :]
    columns = np.zeros((count * n, 2))
    columns[:, 0], columns[:, 1] = -last[:, :, n + 1].ravel(), -last[:, :, n + 2].ravel()
    rows, corner, right_side = np.zeros((2, count * n)), np.zeros((2, 2)), np.append(last[:, :, n].ravel(), values)
    for i, condition in enumerate(conditions):
        weights = np.broadcast_to(condition.nodes, (count, DEGREE + 1, n))
        inside = weights[:, 1:, :].reshape(count, 1, DEGREE * n) @ response
        rows[i] = (weights[:, 0, :] + inside[:, 0, :n]).ravel()
        corner[i] = condition.log_period + inside[:, 0, n + 1].sum(), condition.parameter + inside[:, 0, n + 2].sum()
        right_side[count * n + i] -= inside[:, 0, n].sum()
    solution = _solve_bordered(last[:, :, :n], columns, rows, corner, right_side)
    first = solution[:-2].reshape(count, n)
    known = np.concatenate(
        [first, np.ones((count, 1)), np.full((count, 1), solution[-2]), np.full((count, 1), solution[-1])], axis=1
    )
    inner_nodes = (response @ known[..., None])[..., 0].reshape(count, DEGREE, n)
    nodes = np.concatenate([first[:, None, :], inner_nodes[:, :-1, :]], axis=1).reshape(count * DEGREE, n)
    return Orbit(orbit.mesh, nodes, float(solution[-2]), float(solution[-1]))


def _solve_bordered(transfer: Array, columns: Array, rows: Array, corner: Array, right: Array) -> Array:
    """Solves d_(j+1) - G_j d_j = ... for `transfer` [N, n, n], cyclic in j and bordered by two columns and two rows."""
    from scipy.sparse import csc_matrix
    from scipy.sparse.linalg import splu

    count, n, _ = transfer.shape
    inner_size = count * n
    index = np.arange(inner_size).reshape(count, n)
    blocks = np.broadcast_to(index[:, :, None], transfer.shape), np.broadcast_to(index[:, None, :], transfer.shape)
    borders = np.indices((inner_size, 2))
    row = [blocks[0], index, borders[0], borders[1] + inner_size, np.indices((2, 2))[0] + inner_size]
    column = [
        blocks[1],
        np.roll(index, -1, axis=0),
        borders[1] + inner_size,
        borders[0],
        np.indices((2, 2))[1] + inner_size,
    ]
    value = [-transfer, np.ones((count, n)), columns, rows.T, corner]
    matrix = csc_matrix((_flat(value), (_flat(row), _flat(column))), shape=(inner_size + 2, inner_size + 2))
    try:
        return np.asarray(splu(matrix, permc_spec="NATURAL").solve(right))
    except RuntimeError as error:  # SuperLU's word for an exactly singular matrix
        raise np.linalg.LinAlgError(str(error)) from error


def _flat(parts: list[Array]) -> Array:
    return np.concatenate([np.ravel(part) for part in parts])


# ---------------------------------------------------------------------- mesh
def monitor(orbit: Orbit) -> Array:
    """The size [N] of the (m+1)-th derivative on every interval, from jumps of the m-th (de Boor's estimate)."""
    steps = np.diff(orbit.mesh)
    highest = np.einsum("k,jkn->jn", basis(DEGREE).leading, orbit.local) / steps[:, None] ** DEGREE
    before, after = np.roll(steps, 1), np.roll(steps, -1)
    left = np.linalg.norm(highest - np.roll(highest, 1, axis=0), axis=1) / ((steps + before) / 2.0)
    right = np.linalg.norm(np.roll(highest, -1, axis=0) - highest, axis=1) / ((steps + after) / 2.0)
    return np.asarray((left + right) / 2.0)


def error_estimate(orbit: Orbit) -> float:
    """The largest local error, h^(m+1) times the (m+1)-th derivative over (m+1)!, in scaled variables."""
    factorial = float(np.prod(np.arange(1, DEGREE + 2)))
    return float(np.max(np.diff(orbit.mesh) ** (DEGREE + 1) * monitor(orbit))) / factorial


def adapted_mesh(orbit: Orbit, intervals: int) -> Array:
    """A mesh of so many intervals that spreads the local error evenly."""
    density = monitor(orbit) ** (1.0 / (DEGREE + 1))
    density = density + 0.1 * float(np.mean(density)) + 1e-12
    # A running mean keeps neighbouring intervals alike in length.
    density = (np.roll(density, 1) + 2.0 * density + np.roll(density, -1)) / 4.0
    total = np.concatenate([[0.0], np.cumsum(density * np.diff(orbit.mesh))])
    mesh = np.interp(np.linspace(0.0, total[-1], intervals + 1), total, orbit.mesh)
    mesh[0], mesh[-1] = 0.0, 1.0
    return mesh
