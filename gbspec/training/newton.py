"""The Levenberg-Marquardt stage: robust, damped, checkpointed after every iteration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbspec.data.trajectories import Array
from gbspec.training.jacobian import linearise
from gbspec.training.levenberg import NormalEquations, Prior, huber, huber_weights
from gbspec.training.parameters import Parameters
from gbspec.training.problem import Problem
from gbspec.training.stages import Outcome, State, mean_loss, require_finite, scalar
from gbspec.training.unroll import solve

DELTA_HIGH, DELTA_LOW = 0.1, 0.003
"""Huber's threshold, in deviations of the data: four times the median residual, within these bounds."""
ATTEMPTS = 10
"""Dampings tried in one iteration before the stage gives up."""


@dataclass(frozen=True)
class LevenbergOptions:
    """`robust`: Huber's function (else least squares); `tolerance`: relative decrease below which the stage ends
    (twice in a row); `damping`: the first one."""

    robust: bool = True
    tolerance: float = 1e-3
    damping: float = 1.0


class LevenbergMarquardt:
    """Minimises the problem that `problem_at(iteration)` gives (always the same one unless sub-steps are random)."""

    def __init__(
        self,
        name: str,
        total: int,
        problem_at: Callable[[int], Problem],
        parameters: Parameters,
        options: LevenbergOptions,
        prior: Prior | None = None,
    ) -> None:
        self.name, self.total, self.problem_at, self.parameters = name, total, problem_at, parameters
        self.options = options
        self.prior = prior if prior is not None else Prior(np.zeros(parameters.size), np.zeros(parameters.size))

    def begin(self, theta: Array) -> State:
        """The vector, the damping, and how often in a row the decrease was small."""
        return {"theta": theta, "damping": np.array(self.options.damping), "small": np.array(0.0)}

    def threshold(self, residuals: Array) -> float:
        """Huber's threshold for these residuals."""
        if not self.options.robust or not len(residuals):
            return float("inf")
        return float(np.clip(4 * np.median(np.abs(residuals)), DELTA_LOW, DELTA_HIGH))

    def step(self, state: State, iteration: int) -> Outcome:
        """One Jacobian, and as many dampings as it takes to improve."""
        problem, theta = self.problem_at(iteration), state["theta"]
        damping, small = scalar(state, "damping"), scalar(state, "small")
        system = linearise(problem, self.parameters, theta)
        residuals = system.residuals.numpy()
        require_finite(problem, self.parameters, theta, residuals, self.name)
        delta = self.threshold(residuals)
        value = huber(residuals, delta) + self.prior.value(theta)
        weights = huber_weights(residuals, delta)
        equations = NormalEquations(system, self.parameters, weights, self.prior, theta)
        for _ in range(ATTEMPTS):
            step = equations.solve(damping)
            trial = theta + step
            new_residuals = solve(problem, self.parameters, trial)
            new = huber(new_residuals, delta) + self.prior.value(trial)
            if new < value:
                break
            damping *= 4
        else:
            kept: State = {"theta": theta, "damping": np.array(damping), "small": np.array(2.0)}
            return Outcome(kept, mean_loss(residuals), True)
        predicted = equations.predicted_decrease(step)
        gain = (value - new) / max(predicted, 1e-300)
        # The better the linear model foretold the decrease, the less damping it needs (Nielsen 1999).
        damping *= float(np.clip(1 - (2 * gain - 1) ** 3, 0.2, 2.0))
        decrease = (value - new) / max(value, 1e-300)
        small = small + 1 if decrease < self.options.tolerance else 0.0
        after: State = {"theta": trial, "damping": np.array(damping), "small": np.array(small)}
        return Outcome(after, mean_loss(new_residuals), small >= 2)
