"""Whole solutions from a second vector: that of the warm start, or one that was left though it was better.

Teacher forcing leads constants, initial states and functions together to where predictions from row to row are best.
With noise and unmeasured states this may be the basin of a wrong minimum of whole solutions, which the first guess of
all of them is not in. Where few values were measured, a second fit is cheap, and the evidence compares both.

Segments have initial states of their own, so that growing horizons may end where whole solutions follow the data less
well than before, and their fit from there too: where no state is measured, teacher forcing fits whole solutions (the
flow of a snowy catchment: a loss of 0.45 before, 0.53 after both).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import (
    LevenbergMarquardt,
    LevenbergOptions,
    Outcome,
    Stage,
    State,
    huber,
    huber_limit,
    log_evidence,
)
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.planned import Planned, Reached, always, shortened
from gbspec.training.stages import StageName
from gbspec.training.starts import refit_starts

CLEARLY = 2.0
"""The other vector is gone on with if its log evidence is larger by this, and its loss not larger."""

WORTHWHILE = 0.01
"""A vector before growing horizons is gone back to if that lowers Huber's function of whole solutions, which the fit
minimises, by more than this part."""
BEFORE = (StageName.STARTS_AGAIN, StageName.TEACHER)
"""The stages before growing horizons, the last one first."""


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
        return Outcome({"theta": theta}, _loss(self.engine, theta), True)

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
        if not _loss(self.engine, found) <= _loss(self.engine, present):
            return False
        values = [log_evidence(self.engine, theta) for theta in (found, present)]
        return values[0] is not None and values[1] is not None and values[0] > values[1] + CLEARLY


class WayBack:
    """Returns to a vector that an earlier stage has reached."""

    name, total = StageName.OTHER_START.value, 1

    def __init__(self, engine: Engine, earlier: Array) -> None:
        self.engine, self.earlier = engine, earlier

    def begin(self, theta: Array) -> State:
        """The state of the stage: the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """The earlier vector."""
        return Outcome({"theta": self.earlier}, _loss(self.engine, self.earlier), True)


def other_starts(
    context: Context,
    layout: Parameters,
    fit: Planned,
    options: Callable[[Reached], LevenbergOptions],
    iterations: int,
) -> list[Planned]:
    """The stage, and the `fit` of whole solutions again where it has replaced the vector: from the warm start, with at
    most so many iterations, or, where these are 0, from where growing horizons began, if whole solutions of this
    `layout` followed the data better there."""

    def engine(reached: Reached) -> Engine:
        return context.engine(layout, 0.0, shortened(reached.begun))

    def left(reached: Reached) -> Array | None:
        marks, whole = reached.marks, engine(reached)
        name = next((one for one in BEFORE if one in marks), None)
        if StageName.HORIZONS not in marks or name is None:
            return None
        before = refit_starts(whole, marks[name], context.seed)
        residuals = [residual_vector(whole, theta) for theta in (before, reached.theta)]
        limit = whole.problem.limit(huber_limit(whole.problem.of_noise(residuals[1])))
        earlier, now = (huber(each, limit) for each in residuals)
        return before if earlier < (1 - WORTHWHILE) * now else None

    def make(reached: Reached) -> Stage:
        earlier = None if iterations else left(reached)
        if earlier is not None:
            return WayBack(engine(reached), earlier)
        other = reached.marks[StageName.WARM_START]
        return OtherStart(engine(reached), other, options(replace(reached, theta=other)), iterations)

    def possible(reached: Reached) -> bool:
        return StageName.AUTOREGRESSIVE in reached.marks and (iterations > 0 or left(reached) is not None)

    def replaced(reached: Reached) -> bool:
        found = reached.marks.get(StageName.OTHER_START)
        return found is not None and not np.array_equal(found, reached.marks[StageName.AUTOREGRESSIVE])

    stage = Planned(StageName.OTHER_START, 1, make, possible=possible)
    return [stage, replace(fit, wanted=always, possible=replaced)]


def _loss(engine: Engine, theta: Array) -> float:
    return mean_loss(residual_vector(engine, theta))
