"""The stage of L-BFGS on all trajectories together."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, loss_and_gradient, residual_vector
from gbspec.training.optimise.lbfgs import MEMORY, inverse_times, of_newest_curvature
from gbspec.training.optimise.priors import Priors, priors_at
from gbspec.training.optimise.stage import Outcome, State, require_finite
from gbspec.training.problem import mean_loss


class LimitedMemory:
    """L-BFGS (Nocedal 1980) with backtracking to Armijo's condition; each step of the stage is an iteration."""

    def __init__(self, name: str, total: int, engine_at: Callable[[int], Engine]) -> None:
        self.name, self.total, self.engine_at = name, total, engine_at

    def begin(self, theta: Array) -> State:
        """The initial state: the vector and an empty memory."""
        return {"theta": theta, "steps": np.zeros((0, len(theta))), "changes": np.zeros((0, len(theta)))}

    def step(self, state: State, iteration: int) -> Outcome:
        """One quasi-Newton step."""
        engine, theta = self.engine_at(iteration), state["theta"]
        priors = priors_at(engine, theta)
        count = max(int(engine.problem.seen.sum()), 1)
        value, gradient = self._objective(engine, priors, count, theta)
        require_finite(engine, theta, np.array([value, *gradient]), self.name)
        pairs = list(zip(state["steps"], state["changes"], strict=True))
        direction = -inverse_times(gradient, pairs, of_newest_curvature(pairs))
        slope = float(gradient @ direction)
        if slope >= 0:
            direction, slope = -gradient, -float(gradient @ gradient)
        length = 1.0 if pairs else min(1.0, 0.1 / max(float(np.linalg.norm(gradient)), 1e-300))
        for _ in range(30):
            trial = theta + length * direction
            residuals = residual_vector(engine, trial)
            reached = mean_loss(residuals) + priors.penalty(trial) / count
            if reached <= value + 1e-4 * length * slope:
                break
            length *= 0.5
        else:
            return Outcome(state, value - priors.penalty(theta) / count, True)
        _, new_gradient = self._objective(engine, priors, count, trial)
        s, y = trial - theta, new_gradient - gradient
        steps, changes = state["steps"], state["changes"]
        if float(s @ y) > 1e-12 * float(y @ y):
            steps, changes = np.vstack([steps, s])[-MEMORY:], np.vstack([changes, y])[-MEMORY:]
        after: State = {"theta": trial, "steps": steps, "changes": changes}
        return Outcome(after, mean_loss(residuals), value - reached <= 1e-9 * max(value, 1e-300))

    def _objective(self, engine: Engine, priors: Priors, count: int, theta: Array) -> tuple[float, Array]:
        """The mean loss and the priors' penalty, with their gradient."""
        value, gradient = loss_and_gradient(engine, theta)
        return value + priors.penalty(theta) / count, gradient + priors.gradient(theta) / count
