"""Levenberg-Marquardt steps with the exact Jacobian, identity damping, and Huber's weights.

The damped normal equations `(J^T W J + D) s = -(J^T W r + ridge * (theta - centre))`, D = damping + ridge, are solved
in the smaller of their two forms. With fewer residuals than shared columns: the dual, of the residuals' size. Else the
primal, whose blocks of single trajectories (own constants, initial states) are eliminated first, so that its size is
the number of shared columns whatever the number of trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from gbspec.data.trajectories import Array
from gbspec.training.jacobian import Linearised
from gbspec.training.parameters import Parameters


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior on the trainable vector: `precision` [size] (0: none) around `centre` [size]."""

    precision: Array
    centre: Array

    def value(self, theta: Array) -> float:
        """Half of the weighted squared distance from the centre."""
        return 0.5 * float(np.sum(self.precision * (theta - self.centre) ** 2))


def huber(residuals: Array, delta: float) -> float:
    """Sum of Huber's function: r^2 / 2 up to `delta`, linear beyond; infinite if a residual is not a number."""
    size = np.abs(residuals)
    if not np.isfinite(size).all():
        return float("inf")
    return float(np.where(size <= delta, 0.5 * residuals**2, delta * (size - 0.5 * delta)).sum())


def huber_weights(residuals: Array, delta: float) -> Array:
    """Weights of iteratively reweighted least squares for Huber's function (Huber 1981)."""
    size = np.abs(residuals)
    return np.asarray(np.where(size <= delta, 1.0, delta / np.maximum(size, 1e-300)), dtype=np.float64)


class NormalEquations:
    """The linearised problem at one vector, solved for any damping."""

    def __init__(self, system: Linearised, parameters: Parameters, weights: Array, prior: Prior, theta: Array) -> None:
        root = np.sqrt(weights)
        self.parameters = parameters
        self.shared = system.shared.numpy() * root[:, None]
        self.local = system.local.numpy() * root[:, None]
        self.residuals = system.residuals.numpy() * root
        self.owner = system.owner.numpy()
        self.prior, self.offset = prior, theta - prior.centre
        self.groups = [np.flatnonzero(self.owner == i) for i in range(parameters.trajectories)]
        self.uniform = not prior.precision.any()
        self.dual = len(self.residuals) < parameters.n_shared
        self._gram: Array | None = None
        self._factor: tuple[tuple[Array, bool], float] | None = None

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
        np.add.at(local, self.owner, self.local * residuals[:, None])
        return np.concatenate([self.shared.T @ residuals, local.ravel()])

    def gradient(self) -> Array:
        """Gradient of the objective [size]."""
        return self.transposed(self.residuals) + self.prior.precision * self.offset

    def predicted_decrease(self, step: Array) -> float:
        """By how much the linear model says that a step lowers the objective."""
        change = self.times(step)
        quadratic = 0.5 * float(change @ change) + 0.5 * float(np.sum(self.prior.precision * step**2))
        return -float(self.gradient() @ step) - quadratic

    # ---------------------------------------------------------------- solutions
    def solve(self, damping: float, residuals: Array | None = None) -> Array:
        """The step [size] for `damping`; with `residuals`, for these (weighted) ones and without the prior."""
        diagonal = damping + self.prior.precision
        if residuals is None:
            shift = -self.prior.precision / diagonal * self.offset
            # Completing the square in the damping and the prior leaves one diagonal and shifted residuals.
            target = self.residuals + self.times(shift) if not self.uniform else self.residuals
        else:
            shift, target = np.zeros_like(diagonal), residuals
        step = self._solve_dual(diagonal, damping, target) if self.dual else self._solve_primal(diagonal, target)
        return step + shift

    def _solve_dual(self, diagonal: Array, damping: float, target: Array) -> Array:
        if self._factor is None or self._factor[1] != damping:
            self._factor = (
                linalg.cho_factor(self._dual_matrix(diagonal, damping), lower=True, check_finite=False),
                damping,
            )
        y = linalg.cho_solve(self._factor[0], target, check_finite=False)
        return np.asarray(-self.transposed(y) / diagonal, dtype=np.float64)

    def _dual_matrix(self, diagonal: Array, damping: float) -> Array:
        """I + J D^-1 J^T [m, m]."""
        if self.uniform:
            if self._gram is None:
                self._gram = self._dual_gram(np.ones_like(diagonal))
            matrix = self._gram / damping
        else:
            matrix = self._dual_gram(1.0 / diagonal)
        matrix[np.diag_indices_from(matrix)] += 1.0
        return matrix

    def _dual_gram(self, inverse: Array) -> Array:
        parameters = self.parameters
        root = np.sqrt(inverse)
        shared = self.shared * root[: parameters.n_shared] if not self.uniform else self.shared
        gram = shared @ shared.T
        local_root = root[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
        for i, rows in enumerate(self.groups):
            block = self.local[rows] * local_root[i]
            gram[np.ix_(rows, rows)] += block @ block.T
        return np.asarray(gram, dtype=np.float64)

    def _solve_primal(self, diagonal: Array, target: Array) -> Array:
        parameters = self.parameters
        ns, nl = parameters.n_shared, parameters.n_local
        if self._gram is None:
            self._gram = self.shared.T @ self.shared
        gradient = self.transposed(target)
        g_shared, g_local = gradient[:ns].copy(), gradient[ns:].reshape(-1, nl)
        d_local = diagonal[ns:].reshape(-1, nl)
        matrix = self._gram + np.diag(diagonal[:ns])
        inverses, crosses = [], []
        for i, rows in enumerate(self.groups):
            local = self.local[rows]
            inverse = np.linalg.inv(local.T @ local + np.diag(d_local[i]))
            cross = self.shared[rows].T @ local
            g_shared -= cross @ (inverse @ g_local[i])
            inverses.append(inverse)
            crosses.append(cross)
        if crosses and nl:
            wide = np.concatenate([c @ np.linalg.cholesky(v) for c, v in zip(crosses, inverses, strict=True)], axis=1)
            matrix -= wide @ wide.T
        step_shared = -linalg.cho_solve(linalg.cho_factor(matrix, lower=True, check_finite=False), g_shared)
        blocks = [-v @ (g + c.T @ step_shared) for v, g, c in zip(inverses, g_local, crosses, strict=True)]
        return np.concatenate([step_shared, *blocks])
