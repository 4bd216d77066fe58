"""The Levenberg-Marquardt stage: robust, damped, regularised where asked, resumable after every iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbspec.data.trajectories import Array
from gbspec.training.jacobian import linearise
from gbspec.training.levenberg import NormalEquations, huber, huber_weights
from gbspec.training.linearised import Linearised
from gbspec.training.parameters import Parameters
from gbspec.training.priors import Priors
from gbspec.training.problem import Problem
from gbspec.training.stages import Outcome, State, mean_loss, require_finite, scalar
from gbspec.training.unroll import solve

DELTA_HIGH, DELTA_LOW = 0.1, 0.003
"""Huber's threshold, in deviations of the data: four times the median residual, within these bounds."""
ATTEMPTS = 10
"""Dampings tried in one iteration before the stage gives up."""
DIFFERENCE, BEND = 0.1, 0.75
"""The part of a step at which its curvature is taken, and how large the correction may be beside the step."""
WEAK = 1e-2
"""Prior precision of what has no prior, relative to the noise, in the count of degrees of freedom."""


@dataclass(frozen=True)
class LevenbergOptions:
    """How a stage steps and when it ends.

    `robust`: Huber's function, else least squares; `tolerance`: relative decrease below which (twice in a row) the
    stage ends; `enough`: mean loss below which it ends at once; `damping`: the first one; `ridge`: precision of the
    weights' prior in units of squared residuals; `evidence`: let the data set it anew after each iteration.
    """

    robust: bool = True
    tolerance: float = 1e-3
    enough: float = 0.0
    damping: float = 1.0
    ridge: float = 0.0
    evidence: bool = False


class LevenbergMarquardt:
    """Minimises the problem that `problem_at(iteration)` gives (always the same one unless sub-steps are random)."""

    def __init__(
        self,
        name: str,
        total: int,
        problem_at: Callable[[int], Problem],
        parameters: Parameters,
        options: LevenbergOptions,
    ) -> None:
        self.name, self.total, self.problem_at, self.parameters = name, total, problem_at, parameters
        self.options = options

    def begin(self, theta: Array) -> State:
        """The vector, the damping, the ridge, and how often in a row the decrease was small."""
        return {
            "theta": theta,
            "damping": np.array(self.options.damping),
            "ridge": np.array(self.options.ridge),
            "small": np.array(0.0),
        }

    def threshold(self, residuals: Array) -> float:
        """Huber's threshold for these residuals."""
        if not self.options.robust or not len(residuals):
            return float("inf")
        return float(np.clip(4 * np.median(np.abs(residuals)), DELTA_LOW, DELTA_HIGH))

    def step(self, state: State, iteration: int) -> Outcome:
        """One Jacobian, and as many dampings as it takes to improve."""
        problem, theta = self.problem_at(iteration), state["theta"]
        damping, ridge, small = (scalar(state, name) for name in ("damping", "ridge", "small"))
        system = linearise(problem, self.parameters, theta)
        require_finite(problem, self.parameters, theta, system.residuals.numpy(), self.name)
        delta = self.threshold(system.residuals.numpy())
        fit = _Fit(problem, self.parameters, system, theta, delta)
        residuals, count = fit.residuals, fit.count
        equations = NormalEquations(fit.system, self.parameters, fit.weights, ridge, theta)

        def objective(r: Array, at: Array) -> float:
            penalty = ridge * float(np.sum(equations.penalised * at**2)) + fit.balance * float(np.sum(r[count:] ** 2))
            return huber(r[:count], delta) + 0.5 * penalty

        value = objective(residuals, theta)
        for _ in range(ATTEMPTS):
            step = _try_step(equations, damping)
            trial = theta + step
            new_residuals = fit.solved(trial)
            new = objective(new_residuals, trial)
            bent = trial + self._bend(fit, theta, step, equations, damping)
            if not np.array_equal(bent, trial):
                bent_residuals = fit.solved(bent)
                bent_value = objective(bent_residuals, bent)
                if bent_value < new:
                    trial, new_residuals, new = bent, bent_residuals, bent_value
            if new < value:
                break
            damping *= 4
        else:
            kept = state | {"damping": np.array(damping), "small": np.array(2.0)}
            return Outcome(kept, mean_loss(residuals[:count]), True)
        foretold = equations.predicted_decrease(step)  # at rest nothing but rounding, of either sign
        gain = min((value - new) / foretold, 1.0) if foretold > 0 else 1.0
        if self.options.evidence:
            ridge = evidence(equations, residuals[:count], delta, trial, ridge, iteration)
        # The better the linear model foretold the decrease, the less damping it needs (Nielsen 1999).
        damping *= float(np.clip(1 - (2 * gain - 1) ** 3, 0.2, 2.0))
        small = small + 1 if (value - new) < self.options.tolerance * max(value, 1e-300) else 0.0
        after: State = {
            "theta": trial,
            "damping": np.array(max(damping, 1e-12)),
            "ridge": np.array(ridge),
            "small": np.array(small),
        }
        loss = mean_loss(new_residuals[:count])
        return Outcome(after, loss, small >= 2 or loss < self.options.enough)

    def _bend(self, fit: _Fit, theta: Array, step: Array, equations: NormalEquations, damping: float) -> Array:
        """Half the geodesic acceleration along a step (Transtrum and Sethna 2012), zero where it is not a correction.

        The second derivative of the residuals along the step is taken by a difference; in narrow curved valleys, in
        which damped steps must be short, following the curve allows much longer ones.
        """
        ahead = fit.solved(theta + DIFFERENCE * step)
        if not np.isfinite(ahead).all() or not np.isfinite(step).all():
            return np.zeros_like(step)
        root = equations.root
        second = 2 / DIFFERENCE * (root * (ahead - fit.residuals) / DIFFERENCE - equations.times(step))
        bend = 0.5 * equations.respond(second, damping)
        small = 2 * float(np.linalg.norm(bend)) <= BEND * float(np.linalg.norm(step))
        return bend if small else np.zeros_like(step)

    def uncertainty(self, state: State) -> tuple[Array, Array]:
        """Standard deviations [k] and correlations [k, k] of shared constants (natural values) at a converged state.

        The covariance (Gauss-Newton, Laplace) is the noise variance times the inverse of the normal matrix, priors and
        ridge included. How far the next undamped step would move a constant is added to its deviation (in squares), NaN
        where that is more than the deviation itself: the stage had not come to rest. All NaN where the equations are
        singular to rounding, as those of a fit without any residual are.
        """
        try:
            return self._uncertainty(state)
        except np.linalg.LinAlgError:
            return _unknown(len(self.parameters.shared))

    def _uncertainty(self, state: State) -> tuple[Array, Array]:
        parameters, theta, ridge = self.parameters, state["theta"], scalar(state, "ridge")
        problem = self.problem_at(0)
        system = linearise(problem, parameters, theta)
        residuals = system.residuals.numpy()
        if not np.isfinite(residuals).all():
            return _unknown(len(parameters.shared))
        delta = self.threshold(residuals)
        fit = _Fit(problem, parameters, system, theta, delta)
        equations = NormalEquations(fit.system, parameters, fit.weights, ridge, theta)
        weak = WEAK * max(float(np.mean(residuals**2)), 1e-300)
        variance = noise_variance(equations, residuals, delta, equations.degrees_of_freedom(weak, 0))
        ahead, count = _try_step(equations, weak), len(parameters.shared)
        out, inverse = np.zeros(count), np.zeros((count, count))
        slopes = parameters.bijections(parameters.shared).derivative(theta[parameters.n_weights : parameters.n_shared])
        for i, slope in enumerate(slopes):
            unit = np.zeros(parameters.size)
            unit[parameters.n_weights + i] = 1.0
            inverse[i] = equations.invert(unit, weak)[parameters.n_weights : parameters.n_shared]
            own, move = np.sqrt(max(inverse[i, i], 0.0) * variance), float(ahead[parameters.n_weights + i])
            out[i] = abs(float(slope)) * np.hypot(own, move) if abs(move) <= own else np.nan
        roots = np.sqrt(np.maximum(np.diag(inverse), 1e-300)) * np.where(slopes < 0, -1.0, 1.0)
        return out, 0.5 * (inverse + inverse.T) / np.outer(roots, roots)


class _Fit:
    """The residuals of the `count` measured values and, below them, the rows of the priors, around one vector.

    Where Huber's function weighs measurements down, priors count for as much less as the measurements do on average.
    """

    def __init__(
        self, problem: Problem, parameters: Parameters, system: Linearised, theta: Array, delta: float
    ) -> None:
        measured = system.residuals.numpy()
        weights = huber_weights(measured, delta)
        self.problem, self.parameters, self.count = problem, parameters, len(measured)
        self.priors = Priors.of(problem, parameters, measured)
        self.system = self.priors.with_rows(system, theta)
        self.residuals: Array = self.system.residuals.numpy()
        self.balance = float(weights.mean()) if len(weights) else 1.0
        self.weights: Array = np.concatenate([weights, np.full(len(self.priors), self.balance)])

    def solved(self, theta: Array) -> Array:
        """All rows at another vector."""
        return np.concatenate([solve(self.problem, self.parameters, theta), self.priors.rows(theta)])


def _unknown(count: int) -> tuple[Array, Array]:
    """Deviations and correlations of which nothing can be said."""
    return np.full(count, np.nan), np.full((count, count), np.nan)


def _try_step(equations: NormalEquations, damping: float) -> Array:
    """The step; a step of NaN (which no objective accepts) where the equations are singular to rounding."""
    try:
        return equations.step(damping)
    except np.linalg.LinAlgError:
        return np.full(equations.parameters.size, np.nan)


def noise_variance(equations: NormalEquations, residuals: Array, delta: float, freedom: float) -> float:
    """Residual variance with the degrees of freedom that the fit used taken off."""
    weights = huber_weights(residuals, delta)
    return float(np.sum(weights * residuals**2)) / max(len(residuals) - freedom, 0.1 * len(residuals), 1.0)


def evidence(
    equations: NormalEquations, residuals: Array, delta: float, theta: Array, ridge: float, seed: int
) -> float:
    """The ridge that maximises the evidence at the present linearisation (MacKay 1992), approached by half (in logs).

    With gamma effective weights the prior's precision is gamma / |w|^2 and the noise variance is that of the
    residuals with all used degrees of freedom taken off; the ridge is their product.
    """
    parameters = equations.parameters
    weights = theta[: parameters.n_weights]
    size = float(weights @ weights)
    if not len(weights) or size == 0.0:
        return ridge
    scale = max(float(np.mean(residuals**2)), 1e-300)
    freedom = equations.degrees_of_freedom(WEAK * scale, seed)
    unpenalised = len(parameters.shared) + float(parameters.free[parameters.n_shared :].sum())
    effective = max(freedom - unpenalised, 1.0)
    target = noise_variance(equations, residuals, delta, freedom) * effective / size
    return target if ridge <= 0 else float(np.sqrt(ridge * target))
