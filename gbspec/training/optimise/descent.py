"""First-order stages: Adam on minibatches of trajectories with a one-cycle schedule, and L-BFGS on all of them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.objective import half_squares, loss_and_gradient
from gbspec.training.engines.torch.unroll import solve
from gbspec.training.optimise.adam_update import Moments, one_cycle
from gbspec.training.optimise.priors import Priors, priors_at
from gbspec.training.options import TrainOptions
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from gbspec.training.recipe.stages import Outcome, State, mean_loss, require_finite, scalar

MEMORY = 20
"""Pairs of steps and gradient differences that L-BFGS keeps."""


class Adam:
    """Adam (Kingma and Ba 2015); a step of the stage is an epoch.

    The learning rate rises over the first tenth and falls as a cosine (one cycle); gradients are clipped to norm 1.
    Minibatches are drawn from the seed and the epoch's number, so that a resumed stage draws the same ones.
    """

    def __init__(
        self,
        name: str,
        total: int,
        problem_at: Callable[[int], Problem],
        parameters: Parameters,
        options: TrainOptions,
        seed: int,
    ) -> None:
        self.name, self.total, self.problem_at, self.parameters = name, total, problem_at, parameters
        self.options, self.seed = options, seed

    def begin(self, theta: Array) -> State:
        """The vector, both moments, and the number of updates."""
        return {
            "theta": theta,
            "first": np.zeros_like(theta),
            "second": np.zeros_like(theta),
            "updates": np.array(0.0),
        }

    def step(self, state: State, iteration: int) -> Outcome:
        """One pass over all trajectories."""
        problem, parameters = self.problem_at(iteration), self.parameters
        theta = state["theta"]
        measured = np.bincount(
            problem.packed.row_trajectory, (problem.packed.weights > 0).sum(1), problem.packed.trajectories
        )
        priors = priors_at(problem, parameters, theta)
        moments = Moments(state["first"], state["second"], int(scalar(state, "updates")))
        order = np.random.default_rng([self.seed, 61, iteration]).permutation(parameters.trajectories)
        batch = self.options.batch_size
        total = -(-len(order) // batch) * self.total
        for begin in range(0, len(order), batch):
            index = np.sort(order[begin : begin + batch]).astype(np.int64)
            value, gradient = half_squares(problem, parameters, theta, index)
            if not np.isfinite(value) or not np.isfinite(gradient).all():
                require_finite(problem, parameters, theta, np.array([np.nan]), self.name)
            gradient /= max(int(measured[index].sum()), 1)
            gradient += priors.gradient(theta) / max(int(measured.sum()), 1)
            rate = one_cycle(moments.updates + 1, total, self.options.learning_rate)
            moments, step = moments.advance(gradient, rate)
            theta = theta + step
        residuals = solve(problem, parameters, theta)
        require_finite(problem, parameters, theta, residuals, self.name)
        after: State = {
            "theta": theta,
            "first": moments.first,
            "second": moments.second,
            "updates": np.array(float(moments.updates)),
        }
        return Outcome(after, mean_loss(residuals), False)


class LimitedMemory:
    """L-BFGS (Nocedal 1980) with backtracking to Armijo's condition; a step of the stage is an iteration."""

    def __init__(
        self, name: str, total: int, problem_at: Callable[[int], Problem], parameters: Parameters, batch: int
    ) -> None:
        self.name, self.total, self.problem_at, self.parameters, self.batch = name, total, problem_at, parameters, batch

    def begin(self, theta: Array) -> State:
        """The vector and an empty memory."""
        return {"theta": theta, "steps": np.zeros((0, len(theta))), "changes": np.zeros((0, len(theta)))}

    def step(self, state: State, iteration: int) -> Outcome:
        """One quasi-Newton step."""
        problem, theta = self.problem_at(iteration), state["theta"]
        priors = priors_at(problem, self.parameters, theta)
        count = max(int((problem.packed.weights > 0).sum()), 1)
        value, gradient = self._objective(problem, priors, count, theta)
        require_finite(problem, self.parameters, theta, np.array([value, *gradient]), self.name)
        direction = -self._apply(state, gradient)
        slope = float(gradient @ direction)
        if slope >= 0:
            direction, slope = -gradient, -float(gradient @ gradient)
        length = 1.0 if len(state["steps"]) else min(1.0, 0.1 / max(float(np.linalg.norm(gradient)), 1e-300))
        for _ in range(30):
            trial = theta + length * direction
            residuals = solve(problem, self.parameters, trial)
            reached = mean_loss(residuals) + priors.penalty(trial) / count
            if reached <= value + 1e-4 * length * slope:
                break
            length *= 0.5
        else:
            return Outcome(state, value - priors.penalty(theta) / count, True)
        _, new_gradient = self._objective(problem, priors, count, trial)
        s, y = trial - theta, new_gradient - gradient
        steps, changes = state["steps"], state["changes"]
        if float(s @ y) > 1e-12 * float(y @ y):
            steps, changes = np.vstack([steps, s])[-MEMORY:], np.vstack([changes, y])[-MEMORY:]
        after: State = {"theta": trial, "steps": steps, "changes": changes}
        return Outcome(after, mean_loss(residuals), value - reached <= 1e-9 * max(value, 1e-300))

    def _objective(self, problem: Problem, priors: Priors, count: int, theta: Array) -> tuple[float, Array]:
        """The mean loss and the priors' penalty, with their gradient."""
        value, gradient = loss_and_gradient(problem, self.parameters, theta, self.batch)
        return value + priors.penalty(theta) / count, gradient + priors.gradient(theta) / count

    @staticmethod
    def _apply(state: State, gradient: Array) -> Array:
        """The inverse Hessian's approximation times a vector: the two-loop recursion."""
        pairs = list(zip(state["steps"], state["changes"], strict=True))
        q, factors = gradient.copy(), []
        for s, y in reversed(pairs):
            factor = float(s @ q) / float(s @ y)
            factors.append(factor)
            q -= factor * y
        if pairs:
            s, y = pairs[-1]
            q *= float(s @ y) / float(y @ y)
        for (s, y), factor in zip(pairs, reversed(factors), strict=True):
            q += s * (factor - float(y @ q) / float(s @ y))
        return q
