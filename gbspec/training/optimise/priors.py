"""Prior distributions of constants in the fit: `prior normal(mean, sd)` and `prior lognormal(median, cv)`.

The learned initial value of an unmeasured state has a normal prior too if the state declares a range: its mean is the
guess of the start, else the middle of the range, its standard deviation half the range. Without it nothing keeps such
a value near the plausible ones while the functions of this state are still wrong.

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

SMOOTH = 10.0
"""The prior standard deviation of the biases of splines that are second differences (`gbspec.passes.splines`): wide,
since where data are noisy the ridge of the evidence estimates it. It fills places without data by straight lines."""


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
    """The P rows of all priors: one for each shared constant, one per trajectory for each constant per trajectory and
    for each initial value with a prior.

    `noise` weighs the priors of constants; `spread`, the root mean square of the residuals if that is larger, those of
    initial values: while the fit is bad these must not give way to errors of the functions. `column` [P] is the entry
    of the trainable vector that a row depends on, `owner` [P] its trajectory (0: shared).
    """

    parameters: Parameters
    noise: float
    spread: float
    column: Integers
    owner: Integers

    @staticmethod
    def of_likelihood(problem: Problem, parameters: Parameters) -> Priors:
        """The same beside a negative log likelihood, which contains the noise."""
        return replace(Priors.of(problem, parameters, np.zeros(1)), noise=1.0)

    @staticmethod
    def of(problem: Problem, parameters: Parameters, residuals: Array) -> Priors:
        """The priors of learnables and initial values; the noise is estimated from `residuals` if not stated."""
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
        for i, _, _ in _guessed(parameters):
            owner = np.flatnonzero(parameters.start_free[:, i]).astype(np.int64)
            columns.append(parameters.n_shared + owner * local + len(parameters.own) + i)
            owners.append(owner)
        smooth = _smooth(parameters)
        columns.append(smooth)
        owners.append(np.zeros(len(smooth), dtype=np.int64))
        stated = problem.scaling.noise
        if stated is None:
            stated = max(typical(problem.of_noise(residuals)), LEAST_NOISE) if len(columns) > 1 else 0.0
        spread = max(stated, root_mean_square(residuals))
        return Priors(parameters, stated, spread, np.concatenate(columns), np.concatenate(owners))

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
        for i, center, sd in _guessed(parameters):
            free = torch.from_numpy(np.flatnonzero(parameters.start_free[:, i]))
            found.append(self.spread * (parameters.starts(theta)[free, i] - center) / sd)
        found.append(self.noise * theta[torch.from_numpy(_smooth(parameters))] / SMOOTH)
        return torch.cat(found)

    def slopes(self, theta: Array) -> Array:
        """The derivative of each row with respect to the one entry that it depends on [P]."""
        vector = torch.from_numpy(theta.copy()).requires_grad_()
        rows = self._rows(vector)
        if not rows.requires_grad:
            return np.zeros(0)
        (gradient,) = torch.autograd.grad(rows.sum(), vector)
        return np.asarray(gradient.numpy()[self.column], dtype=np.float64)


def root_mean_square(residuals: Array) -> float:
    """That of finite residuals; 0 if there are none or not all are finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        found = float(np.sqrt(np.mean(residuals**2))) if len(residuals) else 0.0
    return found if np.isfinite(found) else 0.0


def priors_at(engine: Engine, theta: Array) -> Priors:
    """The priors at a vector; its residuals are computed only if the noise is estimated from them."""
    problem, parameters = engine.problem, engine.parameters
    learned = bool(_with_prior(parameters)) or len(_smooth(parameters)) > 0
    needed = bool(_guessed(parameters)) or (problem.scaling.noise is None and learned)
    return Priors.of(problem, parameters, residual_vector(engine, theta) if needed else np.zeros(0))


def _with_prior(parameters: Parameters) -> list[int]:
    """Indices of the learnables that have a prior."""
    return [i for i, learnable in enumerate(parameters.model.learnables) if learnable.prior is not None]


def _smooth(parameters: Parameters) -> Integers:
    """The entries of the trainable vector that are second differences of splines' coefficients."""
    places = {f"network.{n.name}.0.bias": n.smooth for n in parameters.model.networks if n.smooth}
    found, position = [np.zeros(0, dtype=np.int64)], 0
    for name, shape in parameters.weight_shapes.items():
        found.append(position + np.array(places.get(name, ()), dtype=np.int64))
        position += int(np.prod(shape))
    return np.concatenate(found)


def _guessed(parameters: Parameters) -> list[tuple[int, float, float]]:
    """Indices of the unmeasured states with learned initial values and a bounded declared range, with the mean and the
    standard deviation of their priors: the guess (else the middle) and half the width of the range."""
    model, found = parameters.model, []
    measured = {channel.state for channel in model.channels}
    for i, state in enumerate(model.states):
        given = state.range
        if i not in measured and given is not None and given.bounded and parameters.start_free[:, i].any():
            center = 0.5 * (given.low + given.high) if state.start is None else state.start
            found.append((i, center, 0.5 * (given.high - given.low)))
    return found


def widest(parameters: Parameters, theta: Array) -> Array:
    """The standard deviations [k] of the priors of shared constants, in their units at a vector; infinite without one.
    No posterior is wider, though Huber's factor, which is one of measurements, would make it so."""
    out = np.full(len(parameters.shared), np.inf)
    values = parameters.bijections(parameters.shared).to_natural(torch.from_numpy(theta[parameters.places])).numpy()
    for i in _with_prior(parameters):
        prior = parameters.model.learnables[i].prior
        if prior is not None and i in parameters.shared:
            place = parameters.shared.index(i)
            out[place] = prior_sd(prior) * (1.0 if prior.kind == "normal" else abs(float(values[place])))
    return out
