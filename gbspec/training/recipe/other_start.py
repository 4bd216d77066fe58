"""Whole solutions of few data from a second vector, that of the warm start.

Teacher forcing leads constants, initial states and functions together to where predictions from row to row are best.
With noise and unmeasured states this may be the basin of a wrong minimum of whole solutions, which the first guess of
all of them is not in. Where few values were measured, a second fit is cheap, and the evidence compares both.
"""

from __future__ import annotations

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Outcome, State, log_evidence
from gbspec.training.problem import mean_loss
from gbspec.training.stages import StageName

CLEARLY = 2.0
"""The other vector is gone on with if its log evidence is larger by this, and its loss not larger."""


class OtherStart:
    """Levenberg-Marquardt from the vector `other`; its end replaces the present one if it is clearly better."""

    name, total = StageName.OTHER_START.value, 1

    def __init__(self, engine: Engine, other: Array, options: LevenbergOptions, iterations: int) -> None:
        self.engine, self.other, self.options, self.iterations = engine, other, options, iterations

    def begin(self, theta: Array) -> State:
        """The state of the stage: the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """The fit from the other vector, and the better of both."""
        present, found = state["theta"], self._fitted()
        theta = found if found is not None and self._better(found, present) else present
        return Outcome({"theta": theta}, self._loss(theta), True)

    def _fitted(self) -> Array | None:
        """The vector that least squares reach; None if they cannot begin."""
        stage = LevenbergMarquardt(self.name, self.iterations, lambda i: self.engine, self.options)
        state = stage.begin(self.other)
        for i in range(self.iterations):
            try:
                outcome = stage.step(state, i)
            except ComputationError:
                return None if i == 0 else state["theta"]
            state = outcome.state
            if outcome.done:
                break
        return state["theta"]

    def _better(self, found: Array, present: Array) -> bool:
        if not self._loss(found) <= self._loss(present):
            return False
        values = [log_evidence(self.engine, theta) for theta in (found, present)]
        return values[0] is not None and values[1] is not None and values[0] > values[1] + CLEARLY

    def _loss(self, theta: Array) -> float:
        return mean_loss(residual_vector(self.engine, theta))
