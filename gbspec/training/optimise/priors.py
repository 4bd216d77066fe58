"""Prior distributions of constants in the fit: `prior normal(mean, sd)` and `prior lognormal(median, cv)`.

Each prior is a row of the sum of squares, `noise * (k - mean) / sd`, or of logarithms under a lognormal prior, whose
standard deviation is then sqrt(log(1 + cv^2)). `noise` is the standard deviation of the measurements' noise in units of
the residuals. The minimum of the sum is then the most probable vector, and the inverse of the normal matrix, times the
variance of the noise, the covariance of the posterior of a linear model (Gelman et al., Bayesian Data Analysis, 14.8).
The noise is known if every channel states its own; otherwise it is estimated from the current residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Prior
from gbspec.training.engines import Engine, Linearised, residual_vector
from gbspec.training.problem import Integers, Parameters, Problem, typical

LEAST_NOISE = 1e-6
"""Lower bound of the noise: with exact data a prior matters only for what they do not determine, but must not
vanish."""


def prior_sd(prior: Prior) -> float:
    """The standard deviation of a constant, or of its logarithm under a lognormal prior."""
    return prior.scale if prior.kind == "normal" else float(np.sqrt(np.log1p(prior.scale**2)))


def standardised(prior: Prior, value: Tensor) -> Tensor:
    """The difference of values from the prior's center, in units of its standard deviation."""
    if prior.kind == "normal":
        return (value - prior.location) / prior.scale
    return (torch.log(value) - float(np.log(prior.location))) / prior_sd(prior)


@dataclass(frozen=True)
class Priors:
    """The P rows of all priors: one for each shared constant, one per trajectory for each constant per trajectory.

    `column` [P] is the entry of the trainable vector that a row depends on, `owner` [P] its trajectory (0: shared).
    """

    parameters: Parameters
    noise: float
    column: Integers
    owner: Integers

    @staticmethod
    def of(problem: Problem, parameters: Parameters, residuals: Array) -> Priors:
        """The priors of a model's learnables; the noise is estimated from `residuals` if not stated."""
        count, local = parameters.trajectories, parameters.n_local
        columns, owners = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
        for i in _with_prior(parameters):
            if i in parameters.own:
                owner = np.arange(count, dtype=np.int64)
                columns.append(parameters.n_shared + owner * local + parameters.own.index(i))
            else:
                owner = np.zeros(1, dtype=np.int64)
                columns.append(owner + parameters.n_weights + parameters.shared.index(i))
            owners.append(owner)
        stated = problem.scaling.noise
        if stated is None:
            stated = max(typical(problem.of_noise(residuals)), LEAST_NOISE) if len(columns) > 1 else 0.0
        return Priors(parameters, stated, np.concatenate(columns), np.concatenate(owners))

    def __len__(self) -> int:
        return len(self.column)

    def rows(self, theta: Array) -> Array:
        """The rows [P] at a vector."""
        with torch.no_grad():
            return np.asarray(self._rows(torch.from_numpy(theta)).numpy(), dtype=np.float64)

    def penalty(self, theta: Array) -> float:
        """Half the sum of squared rows."""
        return 0.5 * float(np.sum(self.rows(theta) ** 2))

    def gradient(self, theta: Array) -> Array:
        """The gradient of the penalty [size]."""
        out = np.zeros_like(theta)
        np.add.at(out, self.column, self.rows(theta) * self.slopes(theta))
        return out

    def with_rows(self, system: Linearised, theta: Array) -> Linearised:
        """A linearised problem with the rows of the priors below its own."""
        if not len(self):
            return system
        parameters, slopes = self.parameters, torch.from_numpy(self.slopes(theta))
        shared = torch.zeros((len(self), system.shared.shape[1]), dtype=slopes.dtype)
        local = torch.zeros((len(self), system.local.shape[1]), dtype=slopes.dtype)
        for row, (column, owner) in enumerate(zip(self.column.tolist(), self.owner.tolist(), strict=True)):
            if column >= parameters.n_shared:
                local[row, column - parameters.n_shared - owner * parameters.n_local] = slopes[row]
            elif shared.shape[1]:
                shared[row, column] = slopes[row]
        return replace(
            system,
            residuals=torch.cat([system.residuals, torch.from_numpy(self.rows(theta))]),
            shared=torch.cat([system.shared, shared]),
            local=torch.cat([system.local, local]),
            owner=torch.cat([system.owner, torch.from_numpy(self.owner)]),
        )

    def _rows(self, theta: Tensor) -> Tensor:
        parameters = self.parameters
        constants, known = parameters.constants(theta), len(parameters.model.constants)
        found = [torch.zeros(0, dtype=theta.dtype)]
        for i in _with_prior(parameters):
            values = constants[:, known + i] if i in parameters.own else constants[:1, known + i]
            prior = parameters.model.learnables[i].prior
            if prior is not None:
                found.append(self.noise * standardised(prior, values))
        return torch.cat(found)

    def slopes(self, theta: Array) -> Array:
        """The derivative of each row with respect to the one entry that it depends on [P]."""
        vector = torch.from_numpy(theta.copy()).requires_grad_()
        rows = self._rows(vector)
        if not rows.requires_grad:
            return np.zeros(0)
        (gradient,) = torch.autograd.grad(rows.sum(), vector)
        return np.asarray(gradient.numpy()[self.column], dtype=np.float64)


def priors_at(engine: Engine, theta: Array) -> Priors:
    """The priors at a vector; its residuals are computed only if the noise is estimated from them."""
    stated = engine.problem.scaling.noise is not None or not _with_prior(engine.parameters)
    return Priors.of(engine.problem, engine.parameters, np.zeros(0) if stated else residual_vector(engine, theta))


def _with_prior(parameters: Parameters) -> list[int]:
    """Indices of the learnables that have a prior."""
    return [i for i, learnable in enumerate(parameters.model.learnables) if learnable.prior is not None]
