"""The covariance of weights and shared constants from the curvature at the end of a fit, whatever stage ended it.

The normal matrix of the weighted residuals is reduced to the weights by elimination of all other columns (trajectory by
trajectory, then the shared constants). The precision of the weights' prior is that of the evidence (MacKay 1992), whose
fixed point at one linearisation needs only the eigenvalues of the reduced matrix. `gbspec.runs.Covariance` describes
the result. Eigenvectors that the data do not determine are not stored, and for large networks only the leading ones
are computed: along the others the variance is that of the prior, an upper bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.runs import Covariance
from gbspec.training.engines import Engine, Linearised, linearise
from gbspec.training.optimise.levenberg_marquardt import WEAK
from gbspec.training.optimise.normal_equations import huber_limit, huber_weights, of_estimates
from gbspec.training.optimise.priors import Priors, widest
from gbspec.training.problem import Integers, Parameters

LARGEST = 2**27
"""The most entries of the Jacobian's shared columns (1 GiB): beyond, the covariance is left out."""
DENSE, RANK = 1200, 384
"""With more weights, this many leading eigenvectors are computed by Nystroem's approximation."""
NEGLIGIBLE = 1e-3
"""Eigenvectors along which the data reduce the prior's variance by less than this fraction are not stored."""
UNTOLD = 1e-6
"""Extra weights of which the data tell less than this fraction apart from all others are left out of a test."""
UNFELT = 1e-12
"""Extra weights without an effect at the data are left out too: what little their columns have is rounding."""
LEAST = 1e-12
"""What is added to a normal matrix of unit diagonal before it is inverted."""
FIXED_POINT = 100
"""Iterations of the evidence's fixed point."""


def covariance(engine: Engine, theta: Array, robust: bool = True, most: float = np.inf) -> Covariance | None:
    """The covariance at the end of a fit, by Huber's function (`robust`, with a limit of at most `most`) or least
    squares; None if it is not known (a solution that is not finite, a singular matrix) or too large to be computed."""
    parameters = engine.parameters
    if int(engine.problem.seen.sum()) * parameters.n_shared > LARGEST or not parameters.n_shared:
        return None
    try:
        system = linearise(engine, theta)
        if not bool(np.isfinite(system.residuals.numpy()).all()):
            return None
        return _solved(_Reduced.of(engine, system, theta, robust, most), parameters, theta)
    except np.linalg.LinAlgError:
        return None


def loosened(engine: Engine, theta: Array, held: Integers) -> Array | None:
    """How many times as large the standard deviations of the shared constants [k] are with the constants `held` free as
    with these fixed; None if it is not known or would take too long.

    Each column of the normal matrix counts in its own size: those of constants near a bound are very small.
    """
    n = engine.parameters.n_weights
    try:
        reduced = _reduced_at(engine, theta)
        if reduced is None:
            return None
        matrix = reduced.matrix()
        if n:
            coupling = np.linalg.solve(matrix[n:, n:] + reduced.weak * np.eye(len(matrix) - n), matrix[n:, :n])
            values = np.linalg.eigvalsh(matrix[:n, :n] - matrix[:n, n:] @ coupling)
            ridge, _ = _evidence(reduced, np.maximum(values, 0.0), theta[:n], reduced.used + len(matrix) - n)
            matrix[:n, :n] += ridge * np.eye(n)
        unit = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        matrix = unit[:, None] * matrix * unit + LEAST * np.eye(len(matrix))
        free = np.diag(np.linalg.inv(matrix))[n:]
        kept = np.setdiff1d(np.arange(len(matrix)), n + held)
        fixed = np.diag(np.linalg.inv(matrix[np.ix_(kept, kept)]))[n:]
    except np.linalg.LinAlgError:
        return None
    out = np.ones(len(free))
    out[kept[n:] - n] = np.sqrt(np.maximum(free[kept[n:] - n] / fixed, 1.0))
    return out


def log_evidence(engine: Engine, theta: Array) -> float | None:
    """The logarithm of the evidence at a vector, up to a constant of the problem (Laplace's approximation, with the
    prior of the weights that maximises it); None if it is not known or would take too long.

    The curvature of the trajectories' own parameters counts as constant, by their degrees of freedom.
    """
    n, total = engine.parameters.n_weights, engine.parameters.n_shared
    try:
        reduced = _reduced_at(engine, theta) if n else None
        if reduced is None:
            return None
        matrix = reduced.matrix()
        block = matrix[n:, n:] + reduced.weak * np.eye(total - n)
        values = np.linalg.eigvalsh(matrix[:n, :n] - matrix[:n, n:] @ np.linalg.solve(block, matrix[n:, :n]))
    except np.linalg.LinAlgError:
        return None
    values = np.maximum(values, 0.0)
    others = reduced.used + total - n
    ridge, variance = _evidence(reduced, values, theta[:n], others)
    misfit = reduced.squares + ridge * float(theta[:n] @ theta[:n])
    shrinking = float(np.sum(np.log(ridge / (values + ridge)))) - float(np.linalg.slogdet(block)[1])
    return 0.5 * (shrinking - misfit / variance - (reduced.count - others) * float(np.log(variance)))


def lack_of_fit(engine: Engine, theta: Array, extra: Integers, free: Integers) -> tuple[float, float, float] | None:
    """The score test of the weights `extra`, which are 0 at `theta`: the fraction of the sum of squares that the best
    of them would remove, and the degrees of freedom of the numerator and denominator of its F; None if not known.

    All other parameters move along: the weights `free` and constants without a prior of theirs, all other weights
    with the ridge of the evidence. A ridge of what is tested would leave a bias in the residuals that the extra weights
    find. Without one the test is that of two nested linear models (Rao 1948), one Gauss-Newton step from `theta`.
    """
    n, total = engine.parameters.n_weights, engine.parameters.n_shared
    try:
        reduced = _reduced_at(engine, theta)
        if reduced is None:
            return None
        matrix, gradient = reduced.matrix(), reduced.gradient()
        kept, size = np.setdiff1d(np.arange(total), extra), np.diag(matrix)
        extra = extra[size[extra] > UNFELT * size.max()]
        weights, rest = kept[kept < n], kept[kept >= n]
        block = matrix[np.ix_(rest, rest)] + reduced.weak * np.eye(len(rest))
        wide = matrix[np.ix_(weights, rest)]
        values = np.linalg.eigvalsh(matrix[np.ix_(weights, weights)] - wide @ np.linalg.solve(block, wide.T))
        ridge, _ = _evidence(reduced, np.maximum(values, 0.0), theta[weights], reduced.used + len(rest))
        held = np.setdiff1d(weights, free)
        precision = np.full(total, reduced.weak)
        precision[held] = ridge
        gradient[held] += ridge * theta[held]
        known = matrix[np.ix_(kept, kept)] + np.diag(precision[kept])
        across = np.linalg.solve(known, np.column_stack([matrix[np.ix_(kept, extra)], gradient[kept]]))
        across, step = across[:, :-1], across[:, -1]
        unit = 1 / np.sqrt(size[extra])
        left = matrix[np.ix_(extra, extra)] - matrix[np.ix_(extra, kept)] @ across
        score = unit * (gradient[extra] - across.T @ gradient[kept])
        sizes, vectors = np.linalg.eigh(unit[:, None] * left * unit)
        effective = len(kept) - float(np.sum(precision[kept] * np.diag(np.linalg.inv(known))))
    except np.linalg.LinAlgError:
        return None
    told = sizes > UNTOLD
    gain, count = float(np.sum((vectors[:, told].T @ score) ** 2 / sizes[told])), float(told.sum())
    squares = max(reduced.squares - float(step @ gradient[kept]), 1e-300)
    return gain / squares, count, reduced.count - reduced.used - effective - count


def _reduced_at(engine: Engine, theta: Array) -> _Reduced | None:
    """The normal matrix at a vector; None if it would take too long, or residuals are not finite."""
    n, total = engine.parameters.n_weights, engine.parameters.n_shared
    if n > DENSE or int(engine.problem.seen.sum()) * total > LARGEST:
        return None
    system = linearise(engine, theta)
    if not bool(np.isfinite(system.residuals.numpy()).all()):
        return None
    return _Reduced.of(engine, system, theta)


@dataclass(frozen=True)
class _Reduced:
    """The normal matrix of the shared columns [m, n] after elimination of the trajectories' own.

    `squares` is the sum of squared residuals, `count` their number (as much as each counts), `used` the degrees of
    freedom of own columns; `limited` are the residuals and Huber's limits. `shared` and, for each trajectory, `thin`
    [r, n_local] have the matrix A^T A - sum of (A_i^T T_i)(A_i^T T_i)^T. `rows` [m] are the residuals, of priors too.
    """

    shared: Array
    rows: Array
    thin: tuple[tuple[Integers, Array], ...]
    squares: float
    count: float
    used: float
    weak: float
    limited: tuple[Array, Array | float]

    @classmethod
    def of(
        cls, engine: Engine, system: Linearised, theta: Array, robust: bool = True, most: float = np.inf
    ) -> _Reduced:
        measured = system.residuals.numpy()
        delta = huber_limit(engine.problem.of_noise(measured), most) if robust else np.inf
        limit = engine.problem.limit(delta)
        weights = huber_weights(measured, limit)
        priors = Priors.of(engine.problem, engine.parameters, measured)
        rows = priors.with_rows(system, theta)
        balance = float(weights.mean()) if len(weights) else 1.0
        root = np.sqrt(np.concatenate([weights, np.full(len(priors), balance)]))
        local, owner = rows.local.numpy() * root[:, None], rows.owner.numpy()
        weak = WEAK * max(float(np.mean(measured**2)), 1e-300)
        thin: list[tuple[Integers, Array]] = []
        used = 0.0
        for i in range(engine.parameters.trajectories if local.shape[1] else 0):
            here = np.flatnonzero(owner == i)
            values, vectors = np.linalg.eigh(local[here].T @ local[here])
            values = np.maximum(values, 0.0)
            used += float(np.sum(values / (values + weak)))
            thin.append((here, local[here] @ (vectors / np.sqrt(values + weak))))
        squares, counts = engine.problem.noise_terms(measured)
        known = float(np.sum(weights * squares)), float(counts.sum())
        shared = rows.shared.numpy()
        shared *= root[:, None]  # in place, as it may be large
        return cls(shared, rows.residuals.numpy() * root, tuple(thin), *known, used, weak, (measured, limit))

    def times(self, columns: Array) -> Array:
        """The product [n, k] of the matrix with `columns` [n, k]."""
        return self._transposed(self.shared @ columns)

    def gradient(self) -> Array:
        """The gradient [n] of half the sum of squares, priors included."""
        return self._transposed(self.rows.copy())

    def _transposed(self, rows: Array) -> Array:
        for here, thin in self.thin:
            rows[here] -= thin @ (thin.T @ rows[here])
        return np.asarray(self.shared.T @ rows, dtype=np.float64)

    def matrix(self) -> Array:
        """The matrix [n, n]."""
        out = self.shared.T @ self.shared
        for here, thin in self.thin:
            wide = self.shared[here].T @ thin
            out -= wide @ wide.T
        return np.asarray(0.5 * (out + out.T), dtype=np.float64)


def _solved(reduced: _Reduced, parameters: Parameters, theta: Array) -> Covariance:
    n, total = parameters.n_weights, parameters.n_shared
    unit = np.eye(total)[:, n:]
    columns = reduced.times(unit) if total > n else np.zeros((total, 0))
    block = 0.5 * (columns[n:] + columns[n:].T) + reduced.weak * np.eye(total - n)
    inverse = np.linalg.inv(block) if total > n else np.zeros((0, 0))
    coupling = inverse @ columns[:n].T
    if n <= DENSE:
        matrix = reduced.matrix()[:n, :n] - columns[:n] @ coupling
        values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    else:
        values, vectors = _leading(reduced, columns, coupling, n)
    values = np.maximum(values, 0.0)
    of_constants = float(np.trace(inverse @ (block - reduced.weak * np.eye(total - n))))
    ridge, variance = _evidence(reduced, values, theta[:n], reduced.used + of_constants)
    shares = ridge / (values + ridge) if n else np.zeros(0)
    effective = float(np.sum(1.0 - shares)) + reduced.used + of_constants
    kept = np.flatnonzero(shares < 1 - NEGLIGIBLE)[::-1]
    slopes = parameters.bijections(parameters.shared).derivative(theta[n:total])
    found = Covariance(
        names=tuple(parameters.weight_shapes),
        constants=tuple(parameters.model.learnables[i].name for i in parameters.shared),
        spread=float(np.sqrt(variance / ridge)) if n else 0.0,
        vectors=np.ascontiguousarray(vectors[:, kept].T),
        shares=shares[kept],
        coupling=slopes[:, None] * coupling,
        conditional=slopes[:, None] * (variance * inverse) * slopes,
    )
    found = found.widened(float(np.sqrt(of_estimates(*reduced.limited, effective))))
    size = np.sqrt(np.maximum(np.diag(found.conditional), 1e-300))
    share = np.minimum(1.0, widest(parameters, theta) / size)
    return replace(found, conditional=share[:, None] * found.conditional * share)


def _evidence(reduced: _Reduced, values: Array, weights: Array, others: float) -> tuple[float, float]:
    """The ridge that maximises the evidence, and the variance of the residuals, from the eigenvalues [m]."""
    size, ridge = float(weights @ weights), 1e-3 * max(float(values.max(initial=0.0)), 1e-300)
    for _ in range(FIXED_POINT):
        effective = float(np.sum(values / (values + ridge)))
        left = max(reduced.count - effective - others, 0.1 * reduced.count, 1.0)
        variance = max(reduced.squares, 1e-300) / left
        before, ridge = ridge, variance * max(effective, 1.0) / size if size > 0 else ridge
        if abs(np.log(ridge / before)) < 1e-6:
            break
    return ridge, variance


def _leading(reduced: _Reduced, columns: Array, coupling: Array, n: int) -> tuple[Array, Array]:
    """The leading eigenvalues [m] and eigenvectors [n, m] of the weights' matrix, ascending, without forming it.

    Nystroem's approximation from products with random vectors (Frangella, Tropp and Udell 2023, algorithm 2.1).
    """
    test = np.linalg.qr(np.random.default_rng([61, n]).standard_normal((n, RANK)))[0]
    padded = np.concatenate([test, np.zeros((len(reduced.shared.T) - n, RANK))])
    product = reduced.times(padded)[:n] - columns[:n] @ (coupling @ test)
    shift = float(np.finfo(np.float64).eps * np.linalg.norm(product))
    product += shift * test
    core = test.T @ product
    factor = np.linalg.cholesky(0.5 * (core + core.T))
    left, singular, _ = np.linalg.svd(np.linalg.solve(factor, product.T).T, full_matrices=False)
    return np.maximum(singular**2 - shift, 0.0)[::-1], left[:, ::-1]
