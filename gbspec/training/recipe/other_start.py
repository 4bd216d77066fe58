"""Whole solutions of few data from two vectors: that of teacher forcing, and that of the warm start.

Teacher forcing leads constants, initial states and functions together to where predictions from row to row are best.
With noise and unmeasured states this may be the basin of a wrong minimum of whole solutions, which the first guess of
all of them is not in. Where few values were measured, a second fit is cheap, and the evidence compares both.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, State, log_evidence
from gbspec.training.problem import mean_loss
from gbspec.training.stages import StageName

CLEARLY = 2.0
"""The other vector is gone on with if its log evidence is larger by this, and its loss not larger."""


class OtherStart:
    """Levenberg-Marquardt from the present vector, then from `other`; the end with the larger evidence is kept.

    Where the other one is not kept, the vector stays as it was.
    """

    name, total = StageName.OTHER_START.value, 1

    def __init__(
        self, engine: Engine, other: Array, options: Callable[[Array], LevenbergOptions], iterations: int
    ) -> None:
        self.engine, self.other, self.options, self.iterations = engine, other, options, iterations

    def begin(self, theta: Array) -> State:
        """The state of the stage: the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Both fits, and the better vector."""
        theta = state["theta"]
        before, after = (self._fitted(start) for start in (theta, self.other))
        if after is not None and (before is None or self._better(after, before)):
            theta = after
        return Outcome({"theta": theta}, self._loss(theta), True)

    def _fitted(self, theta: Array) -> Array | None:
        """The vector that least squares reach; None if they cannot begin."""
        stage = LevenbergMarquardt(self.name, self.iterations, lambda i: self.engine, self.options(theta))
        state = stage.begin(theta)
        for i in range(self.iterations):
            try:
                outcome = stage.step(state, i)
            except ComputationError:
                return None if i == 0 else state["theta"]
            state = outcome.state
            if outcome.done:
                break
        return state["theta"]

    def _better(self, after: Array, before: Array) -> bool:
        values = [log_evidence(self.engine, theta) for theta in (after, before)]
        if values[0] is None or values[1] is None or not np.isfinite(values[0]):
            return False
        return values[0] > values[1] + CLEARLY and self._loss(after) <= self._loss(before)

    def _loss(self, theta: Array) -> float:
        return mean_loss(residual_vector(self.engine, theta))
