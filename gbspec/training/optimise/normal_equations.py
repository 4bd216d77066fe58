"""Damped least-squares steps from the exact Jacobian, with Huber's weights and a ridge on the network weights.

The damped normal equations `(J^T W J + D) s = -(J^T W r + ridge * w)` (w the network weights, D = damping, plus the
ridge at the weights) are solved in the smaller of their two forms. With fewer residuals than shared columns this is the
dual form, whose size is the number of residuals; otherwise the primal form. In the latter the blocks of single
trajectories (own constants, initial states) are eliminated first, so that its size is the number of shared columns for
any number of trajectories. If both sizes are large (`nystrom.LEAST`), neither matrix is formed if a sketch suffices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines import Linearised
from gbspec.training.optimise.nystrom import LEAST, Blocks, Sketch, TooSlowError
from gbspec.training.problem import Integers, Parameters

Found = TypeVar("Found")

LARGE = 1000
"""Matrices of at least this size are factored by all threads (everything else in training is too small to gain)."""
SINGLE = 300
"""Largest number of solutions with one unit vector each, if there is no shorter way to a diagonal."""
PROBES = 12
"""Random vectors in the estimate of a trace; its relative error is about sqrt(2 / (PROBES * trace))."""
MOSTLY = 0.1
"""The least share of residuals within Huber's limit that counts."""


class _Threads:
    """The number of threads that factor large matrices in this process."""

    large = 1


def use_threads(count: int) -> None:
    """Sets the threads of this process: one for tensors, which are small in training, `count` for large matrices."""
    torch.set_num_threads(1)
    _Threads.large = count


MEDIANS, LEAST_LIMIT = 4.0, 3e-3
"""Huber's limit is so many times the median absolute residual, 2.7 standard deviations of normal noise, with which
estimates have 99.9 % of the efficiency of least squares; and at least this part of a channel's standard deviation."""


def huber_limit(residuals: Array, most: float = float("inf")) -> float:
    """Huber's limit for residuals [m] that have the standard deviation of the noise, and at most `most`; infinite
    without any."""
    return float(np.clip(MEDIANS * np.median(np.abs(residuals)), LEAST_LIMIT, most)) if len(residuals) else float("inf")


def huber(residuals: Array, delta: Array | float) -> float:
    """Sum of Huber's function: r^2 / 2 up to `delta` (one, or one for each), linear beyond; infinite if one is not a
    number."""
    if not np.isfinite(residuals).all():
        return float("inf")
    with np.errstate(over="ignore"):  # residuals of a diverging solution: their sum is infinite
        if np.ndim(delta) == 0 and np.isinf(delta):
            return 0.5 * float(residuals @ residuals)
        return float(huber_each(residuals, delta).sum())


def huber_each(residuals: Array, delta: Array | float) -> Array:
    """Huber's function of each residual; residuals beyond `delta` are never squared, so that they cannot overflow."""
    size = np.abs(residuals)
    inside = np.minimum(size, delta)
    return np.asarray(inside * (size - 0.5 * inside), dtype=np.float64)


def huber_weights(residuals: Array, delta: Array | float) -> Array:
    """Weights of iteratively reweighted least squares for Huber's function (Huber 1981)."""
    size = np.abs(residuals)
    return np.asarray(np.where(size <= delta, 1.0, delta / np.maximum(size, 1e-300)), dtype=np.float64)


def of_estimates(residuals: Array, limit: Array | float, used: float) -> float:
    """The variance of estimates by Huber's function, over that of weighted least squares with its weights.

    With psi the residual, cut at the limit, m the share of residuals within it, p the degrees of freedom `used` and n
    residuals, the covariance is [sum psi^2 / (n - p)] / m^2 times the inverse of J^T J (Huber, Robust Statistics, 1981,
    section 7.6), where weighted least squares have [sum w r^2 / (n - p)] times that of J^T W J: 32 % less of normal
    noise with the limit at its standard deviation. A fit makes up to p residuals nearly zero, so that m is the share of
    the n - p others: without that it was a third of the right one with 20 of 60 degrees of freedom. At least 1: where
    few residuals are far off the theory has less, on which nothing relies.
    """
    weights = huber_weights(residuals, limit)
    squares = float(np.sum(weights * residuals**2))
    if not squares > 0.0 or not len(weights):
        return 1.0
    others = max(len(weights) - used, 1.0)
    within = max((float(np.sum(weights == 1.0)) - used) / others, MOSTLY)
    cut = float(np.sum((weights * residuals) ** 2)) / squares
    return max(cut * float(weights.mean()) / within**2, 1.0)


class Cholesky:
    """A factored symmetric positive definite matrix [n, n] (torch's LAPACK is several times faster than scipy's).

    Raises LinAlgError if the matrix is not numerically positive definite.
    """

    def __init__(self, matrix: Array) -> None:
        before = torch.get_num_threads()
        torch.set_num_threads(_Threads.large if len(matrix) >= LARGE else before)
        try:
            factor, info = torch.linalg.cholesky_ex(torch.from_numpy(matrix))
        finally:
            torch.set_num_threads(before)
        if int(info) != 0:
            raise np.linalg.LinAlgError("the matrix is not positive definite")
        self.factor = factor

    def solve(self, right: Array) -> Array:
        """The solution of A x = right; `right` is [n] or [n, k]."""
        if not len(right):
            return right
        columns = torch.from_numpy(np.ascontiguousarray(right.reshape(len(right), -1)))
        return np.asarray(torch.cholesky_solve(columns, self.factor).numpy().reshape(right.shape), dtype=np.float64)


_Primal = tuple[Cholesky, list[Array], list[Array]]
"""Factor of the shared part, inverses of the trajectories' blocks, and the blocks that join them."""


class NormalEquations:
    """The linearised problem at one vector, solved for any damping; the arrays of `system` are scaled in place.

    `weights` [m] are those of the residuals; `ridge` is the precision of the prior on network weights around zero, in
    units of the residuals.
    """

    def __init__(self, system: Linearised, parameters: Parameters, weights: Array, ridge: float, theta: Array) -> None:
        root = np.sqrt(weights)
        self.parameters = parameters
        self.shared, self.local = system.shared.numpy(), system.local.numpy()
        for part in (self.shared, self.local):  # in place, as the first is as large as memory may allow
            part *= root[:, None]
        self.residuals = system.residuals.numpy() * root
        self.owner = system.owner.numpy()
        self.root = root
        self.ridge = ridge
        self.penalised = np.zeros(parameters.size)
        self.penalised[: parameters.n_weights] = 1.0
        self.theta = theta
        # Of a pooled population all columns of single trajectories are 0: then nothing is to be eliminated.
        self.single = bool(self.local.any())
        self.dual = len(self.residuals) < parameters.n_shared
        large = min(len(self.residuals), parameters.n_shared) >= LEAST
        blocks = Blocks.of(self.local, self.owner, parameters.trajectories)
        self.sketch = Sketch(self.shared, blocks) if large else None
        self._grams: tuple[Array, Array] | None = None
        self._dual_kept: tuple[Cholesky, tuple[float, float]] | None = None
        self._primal_kept: tuple[_Primal, tuple[float, float]] | None = None

    @cached_property
    def groups(self) -> list[Integers]:
        """The residuals of each trajectory."""
        order = np.argsort(self.owner, kind="stable")
        ends = np.searchsorted(self.owner[order], np.arange(1, self.parameters.trajectories), side="left")
        return np.split(order, ends) if self.parameters.trajectories else []

    # ---------------------------------------------------------------- products
    def times(self, step: Array) -> Array:
        """J s (weighted) [m]."""
        parameters = self.parameters
        local = step[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
        shared = self.shared @ step[: parameters.n_shared]
        return np.asarray(shared + np.einsum("ij,ij->i", self.local, local[self.owner]), dtype=np.float64)

    def transposed(self, residuals: Array) -> Array:
        """J^T r [size]."""
        parameters = self.parameters
        local = np.zeros((parameters.trajectories, parameters.n_local))
        with np.errstate(over="ignore"):  # of solutions that blow up: such a step is refused
            np.add.at(local, self.owner, self.local * residuals[:, None])
            return np.concatenate([self.shared.T @ residuals, local.ravel()])

    def gradient(self) -> Array:
        """Gradient of the objective [size]."""
        return self.transposed(self.residuals) + self.ridge * self.penalised * self.theta

    def predicted_decrease(self, step: Array) -> float:
        """The decrease of the objective that the linear model predicts for a step."""
        change = self.times(step)
        quadratic = 0.5 * float(change @ change) + 0.5 * self.ridge * float(np.sum(self.penalised * step**2))
        return -float(self.gradient() @ step) - quadratic

    # ---------------------------------------------------------------- solutions
    def step(self, damping: float) -> Array:
        """The step [size] that minimises the damped linear model."""
        diagonal = damping + self.ridge * self.penalised
        # Completing the square in damping and ridge leaves one diagonal term and shifted residuals.
        shift = -self.ridge * self.penalised / diagonal * self.theta
        target = self.residuals + self.times(shift) if self.ridge else self.residuals
        return self.respond(target, damping) + shift

    def respond(self, target: Array, damping: float) -> Array:
        """-(J^T J + D)^-1 J^T target [size]."""
        found = self._sketched(lambda sketch: sketch.solve(self.transposed(target), self._diagonal(damping)))
        if found is not None:
            return -found
        if self.dual:
            y = self._dual_factor(damping).solve(target)
            return np.asarray(-self.transposed(y) / self._diagonal(damping), dtype=np.float64)
        return -self._primal(self.transposed(target), damping)

    def invert(self, vector: Array, damping: float) -> Array:
        """(J^T J + D)^-1 v [size]."""
        found = self._sketched(lambda sketch: sketch.solve(vector, self._diagonal(damping)))
        if found is not None:
            return found
        if not self.dual:
            return self._primal(vector, damping)
        diagonal = self._diagonal(damping)
        scaled = vector / diagonal
        y = self._dual_factor(damping).solve(self.times(scaled))
        return np.asarray(scaled - self.transposed(y) / diagonal, dtype=np.float64)

    def local_variances(self, damping: float) -> Array:
        """The entries of the trajectories' blocks [N, n_local] on the diagonal of (J^T J + D)^-1; NaN where they would
        take too long."""
        parameters = self.parameters
        shape = parameters.trajectories, parameters.n_local
        if not self.single:
            return 1 / self._diagonal(damping)[parameters.n_shared :].reshape(shape)
        if self.sketch is None and not self.dual:
            factor, inverses, crosses = self._primal_factor(damping)
            # The inverse of a block, plus what it inherits from the uncertainty of the shared part.
            spreads = [(c @ v, v) for c, v in zip(crosses, inverses, strict=True)]
            found = [np.diag(v) + np.einsum("ij,ij->j", wide, factor.solve(wide)) for wide, v in spreads]
            return np.array(found).reshape(shape)
        if parameters.trajectories * parameters.n_local > SINGLE:
            return np.full(shape, np.nan)
        out = np.zeros(parameters.size)
        for i in range(parameters.n_shared, parameters.size):
            unit = np.zeros(parameters.size)
            unit[i] = 1.0
            out[i] = self.invert(unit, damping)[i]
        return out[parameters.n_shared :].reshape(shape)

    def degrees_of_freedom(self, damping: float, seed: int) -> float:
        """tr(J (J^T J + D)^-1 J^T), the effective number of parameters, by Hutchinson's estimator."""
        rng = np.random.default_rng([seed, 53])
        probes = rng.choice([-1.0, 1.0], size=(PROBES, len(self.residuals)))
        found = self._sketched(lambda sketch: sketch.quadratic(probes.T.copy(), self._diagonal(damping)))
        if found is not None:
            return found / PROBES
        if self.dual:
            # J (J^T J + D)^-1 J^T = I - (I + J D^-1 J^T)^-1
            solved = self._dual_factor(damping).solve(probes.T)
            return len(self.residuals) - float(np.sum(probes * solved.T)) / PROBES
        return float(np.mean([-probe @ self.times(self.respond(probe, damping)) for probe in probes]))

    def _sketched(self, of: Callable[[Sketch], Found]) -> Found | None:
        """The result by the sketch; None if that is too slow, now or earlier: the matrices are then factored."""
        if self.sketch is None:
            return None
        try:
            return of(self.sketch)
        except TooSlowError:
            self.sketch = None
            return None

    def _diagonal(self, damping: float) -> Array:
        return np.asarray(damping + self.ridge * self.penalised, dtype=np.float64)

    def _dual_factor(self, damping: float) -> Cholesky:
        """Cholesky factor of I + J D^-1 J^T [m, m]; Gram matrices are formed once, and again where a ridge begins."""
        if self._dual_kept is None or self._dual_kept[1] != (damping, self.ridge):
            if self._grams is None or bool(len(self._grams[1])) != bool(self.ridge):
                self._grams = self._form_grams()
            of_weights, of_rest = self._grams
            if self.ridge:
                matrix = of_weights / (damping + self.ridge)
                matrix += of_rest / damping
            else:
                matrix = of_weights / damping
            matrix[np.diag_indices_from(matrix)] += 1.0
            self._dual_kept = Cholesky(matrix), (damping, self.ridge)
        return self._dual_kept[0]

    def _form_grams(self) -> tuple[Array, Array]:
        """Gram matrices of the weights' columns and of all others; without a ridge, their sum and an empty matrix."""
        weights = self.shared[:, : self.parameters.n_weights]
        constants = self.shared[:, self.parameters.n_weights :]
        rest = constants @ constants.T
        for rows in self.groups if self.single else ():
            block = self.local[rows]
            rest[np.ix_(rows, rows)] += block @ block.T
        gram = weights @ weights.T
        if self.ridge:
            return gram, rest
        gram += rest
        return gram, np.zeros((0, 0))

    def _primal(self, gradient: Array, damping: float) -> Array:
        """(J^T J + D)^-1 g, by elimination of the trajectories' blocks."""
        ns, nl = self.parameters.n_shared, self.parameters.n_local
        factor, inverses, crosses = self._primal_factor(damping)
        if not self.single:
            return np.concatenate([factor.solve(gradient[:ns]), gradient[ns:] / self._diagonal(damping)[ns:]])
        g_shared, g_local = gradient[:ns].copy(), gradient[ns:].reshape(-1, nl)
        for inverse, cross, g in zip(inverses, crosses, g_local, strict=True):
            g_shared -= cross @ (inverse @ g)
        x = factor.solve(g_shared)
        blocks = [v @ (g - c.T @ x) for v, g, c in zip(inverses, g_local, crosses, strict=True)]
        return np.concatenate([x, *blocks])

    def _primal_factor(self, damping: float) -> _Primal:
        if self._primal_kept is not None and self._primal_kept[1] == (damping, self.ridge):
            return self._primal_kept[0]
        ns, nl = self.parameters.n_shared, self.parameters.n_local
        if self._grams is None:
            with np.errstate(over="ignore"):
                self._grams = self.shared.T @ self.shared, np.zeros((0, 0))
        diagonal = self._diagonal(damping)
        matrix = self._grams[0].copy()
        matrix[np.diag_indices_from(matrix)] += diagonal[:ns]
        inverses, crosses = [], []
        for i, rows in enumerate(self.groups if self.single else ()):
            local = self.local[rows]
            own = diagonal[ns + i * nl : ns + (i + 1) * nl]
            inverses.append(np.linalg.inv(local.T @ local + np.diag(own)))
            crosses.append(self.shared[rows].T @ local)
        if crosses and nl:
            wide = [c @ np.linalg.cholesky(0.5 * (v + v.T)) for c, v in zip(crosses, inverses, strict=True)]
            joined = np.concatenate(wide, axis=1)
            matrix -= joined @ joined.T
        self._primal_kept = (Cholesky(matrix), inverses, crosses), (damping, self.ridge)
        return self._primal_kept[0]
