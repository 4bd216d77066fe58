"""The search for starting values of constants: many candidates within their bounds, of which the best are improved."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Engine, explain_failure, residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, Priors, State, huber
from gbspec.training.problem import mean_loss
from gbspec.training.stages import StageName

CANDIDATES, KEPT, IMPROVEMENTS = 64, 4, 12
HALF_WIDTH = 1.0
"""Half width of the candidates' box in trainable units: a factor of e^3 either way, or most of a bounded range."""


class Search:
    """Chooses among the given vector, the declared starting values and random points around both, in one step."""

    name = StageName.SEARCH.value
    total = 1

    def __init__(self, engine: Engine, seed: int) -> None:
        self.engine, self.parameters, self.seed = engine, engine.parameters, seed

    def begin(self, theta: Array) -> State:
        """The initial state: only the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Ranks all candidates by Huber's loss, improves the best few by Levenberg-Marquardt, keeps the best."""
        candidates = self._candidates(state["theta"])
        ranked = sorted((self._loss(theta), i) for i, theta in enumerate(candidates))
        if not np.isfinite(ranked[0][0]):
            raise explain_failure(self.engine.problem, self.parameters, state["theta"], self.name)
        best = min((self._improve(candidates[i]) for _, i in ranked[:KEPT]), key=lambda found: found[0])
        loss = mean_loss(residual_vector(self.engine, best[1]))
        return Outcome({"theta": best[1]}, loss, True)

    def _candidates(self, theta: Array) -> list[Array]:
        parameters = self.parameters
        declared = parameters.vector(parameters.natural(theta))
        columns = slice(parameters.n_weights, parameters.n_shared)
        own = len(parameters.own)
        draws = np.random.default_rng([self.seed, 71]).uniform(
            -HALF_WIDTH, HALF_WIDTH, (CANDIDATES, len(parameters.shared) + own)
        )
        out = [theta, declared]
        for i, draw in enumerate(draws):
            candidate = (theta if i % 2 else declared).copy()
            candidate[columns] += draw[: len(parameters.shared)]
            blocks = candidate[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
            blocks[:, :own] += draw[len(parameters.shared) : len(parameters.shared) + own]
            out.append(candidate)
        return out

    def _loss(self, theta: Array) -> float:
        residuals = residual_vector(self.engine, theta)
        return huber(residuals, 1.0) + self._penalty(theta, residuals)

    def _penalty(self, theta: Array, residuals: Array) -> float:
        """The contribution of the priors to half the sum of squares."""
        return (
            Priors.of(self.engine.problem, self.parameters, residuals).penalty(theta)
            if np.isfinite(residuals).all()
            else 0.0
        )

    def _improve(self, theta: Array) -> tuple[float, Array]:
        options = LevenbergOptions(robust=False, tolerance=1e-3, damping=1e-1)
        stage = LevenbergMarquardt(self.name, IMPROVEMENTS, lambda i: self.engine, options)
        state = stage.begin(theta)
        for i in range(IMPROVEMENTS):
            try:
                outcome = stage.step(state, i)
            except ComputationError:
                return float("inf"), theta
            state = outcome.state
            if outcome.done:
                break
        residuals = residual_vector(self.engine, state["theta"])
        return mean_loss(residuals) + self._penalty(state["theta"], residuals) / max(len(residuals), 1), state["theta"]
