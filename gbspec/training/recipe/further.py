"""Further iterations at effort high: the fit of effort normal is continued, and the better one of both is kept."""

from __future__ import annotations

from gbspec.arrays import Array
from gbspec.training.engines import residual_vector
from gbspec.training.optimise import LevenbergMarquardt, Outcome, State, log_evidence
from gbspec.training.problem import mean_loss
from gbspec.training.stages import StageName

FIRST = "first"
"""The entry of the stage's state with the vector from which it began."""


class Further(LevenbergMarquardt):
    """Continues a fit until it rests, and keeps its first vector if that is better by the criterion of the fit.

    The criterion is the evidence where the weights' prior is estimated by it, otherwise the loss.
    """

    def __init__(self, of: LevenbergMarquardt) -> None:
        super().__init__(StageName.FURTHER.value, of.total, of.engine_at, of.options)

    def begin(self, theta: Array) -> State:
        """The state of the optimiser, and the vector to compare with at the end."""
        return {**super().begin(theta), FIRST: theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """One iteration; after the last one the comparison."""
        first = state[FIRST]
        outcome = super().step({name: value for name, value in state.items() if name != FIRST}, iteration)
        if (outcome.done or iteration + 1 >= self.total) and not self.worse(first, outcome.state["theta"]):
            loss = mean_loss(residual_vector(self.engine_at(0), first))
            return Outcome({**outcome.state, FIRST: first, "theta": first}, loss, True, remark=KEPT)
        return Outcome({**outcome.state, FIRST: first}, outcome.loss, outcome.done)

    def worse(self, theta: Array, other: Array) -> bool:
        """Whether a vector is worse than another one by the criterion of the fit."""
        engine = self.engine_at(0)
        if self.options.evidence:
            evidences = log_evidence(engine, theta), log_evidence(engine, other)
            if evidences[0] is not None and evidences[1] is not None:
                return evidences[0] < evidences[1]
        mine, its = (mean_loss(residual_vector(engine, each)) for each in (theta, other))
        return its < mine


KEPT = "further iterations found nothing better"
