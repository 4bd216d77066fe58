"""Segments of models whose functions are all known: for solutions that follow the data from no start of the search.

Where solutions diverge (chaos, unstable systems) or repeat (oscillations), least squares of whole solutions have minima
far from the data, and constants near the truth have a larger sum of squares than these. Short segments have few minima
(multiple shooting: Bock 1983); longer ones are fitted from there, as far as solutions can be followed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.data import sobol, spread_over_ranges
from gbspec.training.engines import residual_table, residual_vector
from gbspec.training.optimise import Outcome, Stage, State, huber, scalar
from gbspec.training.problem import Parameters
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.growing import AS_SEGMENTS, FOLLOWED, ITERATIONS, GrowingHorizons
from gbspec.training.recipe.planned import Decision, Planned, Reached
from gbspec.training.recipe.segments import Segments, divisible, horizons
from gbspec.training.stages import Effort, StageName
from gbspec.training.starts import PATIENCE, WITH_STARTS, Search, followed

CLEARLY = 0.1
"""Constants of segments replace those of the search if the product of two losses, of the shortest segments and of whole
solutions, is smaller by this factor."""
SAME, TIMES = 1e-3, 3
"""Losses of the same minimum of the shortest segments differ by less than this, relatively; found so often, it is taken
for the best one."""
ATTEMPTS: dict[Effort, int] = {"low": 2, "normal": 8, "high": 16}
"""Starting vectors: that of the search, the declared one, and draws."""
DRAWS = 64
"""Draws of the constants, of which the best ones are starting vectors."""
GROWTH = 1.5
"""Ratio of successive horizons: solutions that diverge can be followed only a little farther than those fitted last."""


class Farthest(GrowingHorizons):
    """Growing horizons of known forms, which keep the vector whose segments are the longest that follow the data.

    Solutions that diverge cannot be followed beyond some length, and whole solutions say nothing of the constants then.
    Of vectors that reach equally far the one with the smaller product of losses is kept, as for unknown functions; the
    vector `present` of the search stays unless that product is clearly smaller.
    """

    def __init__(
        self, context: Context, whole: Parameters, starts: Sequence[Array], effort: Effort, present: Array
    ) -> None:
        super().__init__(context, whole, starts, effort, GROWTH)
        self.present = present

    def begin(self, theta: Array) -> State:
        """The initial state: that of the first attempt, with the vector of the search as the best one."""
        state = super().begin(theta) | self._scored(self.present)
        limit = np.array(CLEARLY * scalar(state, "score"))
        return state | {"score": limit, "limit": limit, "reach": np.array(0.0), "found": np.zeros(0)}

    def _compared(self, state: State, horizon: int, loss: float) -> State:
        """The state with the better one of the best vector so far and the present one."""
        first = loss if horizon == 0 else float(state["found"][-1])
        state = state if horizon else {**state, "found": np.append(state["found"], loss)}
        rows = float(self.horizons[horizon]) if loss < max(FOLLOWED, AS_SEGMENTS * first) else 0.0
        if rows < scalar(state, "reach"):
            return state
        news = self._scored(state["theta"]) | {"reach": np.array(rows)}
        highest = scalar(state, "score" if rows == scalar(state, "reach") else "limit")
        return {**state, **news} if scalar(news, "score") < highest else state

    def _after_horizon(self, state: State, horizon: int, outcome: Outcome) -> Outcome:
        """Goes on as with unknown functions, unless an earlier attempt found this minimum of the shortest segments."""
        before = state["found"][:-1]
        if horizon or not (before <= outcome.loss * (1 + SAME)).any():
            after = super()._after_horizon(state, horizon, outcome)
        else:
            enough = np.sum(state["found"] <= outcome.loss * (1 + SAME)) >= TIMES
            after = self._after_attempt(state, outcome, bool(enough))
        return replace(after, note=after.note or self._note(state)) if after.done else after

    def _note(self, state: State) -> str:
        """What the user has to know where segments are all that was followed."""
        if np.array_equal(state["best"], self.present) or scalar(state, "loss") < FOLLOWED:
            return ""
        said = ONLY_SEGMENTS if divisible(self.context.model) else ONLY_BEGINNINGS
        return said.format(rows=int(scalar(state, "reach")) or self.horizons[0])


@dataclass(frozen=True)
class SegmentsOfKnown:
    """The stage, and what it means for the stages after it.

    `layout` is the vector's layout with free initial states; `astray` tells whether whole solutions at a vector of it
    are far from the data.
    """

    context: Context
    layout: Parameters
    astray: Decision
    effort: Effort

    def planned(self) -> Planned:
        """The stage; the data call for it where whole solutions are far from them and residuals follow one another."""
        parts = len(horizons(self.context, GROWTH))
        total = ATTEMPTS[self.effort] * parts * ITERATIONS[self.effort]

        def wanted(reached: Reached) -> bool:
            engine = self.context.engine(self.layout, 0.0)
            return self.astray(reached) and followed(residual_table(engine, reached.theta), engine.problem)

        return Planned(StageName.HORIZONS, total, self._make, wanted, lambda reached: parts > 0)

    def adopted(self, reached: Reached) -> bool:
        """Whether the segments' vector replaced that of the search."""
        marks = reached.marks
        if StageName.HORIZONS not in marks:
            return False
        return not np.array_equal(marks[StageName.HORIZONS], marks.get(StageName.SEARCH, np.zeros(0)))

    def discarded(self, reached: Reached) -> bool:
        """Whether the vector of the search is still the one to go on with."""
        return not self.adopted(reached)

    def alone(self, reached: Reached) -> bool:
        """Whether segments can be followed and whole solutions cannot: their least squares would move the constants
        away from what segments show."""
        return self.adopted(reached) and self.astray(Reached(reached.marks[StageName.HORIZONS], begun=reached.begun))

    def _make(self, reached: Reached) -> Stage:
        starts = [reached.theta, *self._drawn(reached.theta)]
        return Farthest(self.context, self.layout, starts, self.effort, reached.theta)

    def _drawn(self, theta: Array) -> list[Array]:
        """The declared starting values, and the draws over the ranges that short segments follow best."""
        parameters, learnables, kept = self.layout, self.context.model.learnables, ATTEMPTS[self.effort] - 2
        declared = parameters.vector(parameters.natural(theta))
        if not kept:
            return [declared]
        segments = Segments.of(self.context, parameters, horizons(self.context, GROWTH)[0])
        points = spread_over_ranges(learnables, sobol(DRAWS, len(learnables), self.context.seed))
        drawn = [parameters.vector(parameters.natural(theta), natural) for natural in points]
        losses = [huber(residual_vector(segments.engine, segments.vector(one, None)), 1.0) for one in drawn]
        best = np.argsort(np.where(np.isfinite(losses), losses, np.inf), kind="stable")[:kept]
        return [declared, *(drawn[i] for i in best)]


def search_of_known(context: Context, parameters: Parameters, blend: float) -> Planned:
    """The search for the best minimum, with teacher forcing of strength `blend` (0: of whole solutions)."""
    effort = context.options.effort

    def make(reached: Reached) -> Stage:
        engine, forced = context.engine(parameters, blend), context.engine(parameters, 1.0) if blend == 0.0 else None
        return Search(
            engine,
            forced,
            context.seed,
            effort,
            context.unsized,
            finer=lambda: context.engine(parameters, blend, 0.5),
        )

    return Planned(StageName.SEARCH, PATIENCE[effort].improved, make)


def search_with_starts(context: Context, released: Parameters, drawn: Array, believed: Decision) -> Planned:
    """The search with measured initial values free (the layout `released`), where that with them as measured did not
    find its best minimum several times and they are single measurements of noisy data (`believed`). `drawn` [N,
    n_states] is 1 for the initial values that the draws vary."""
    effort = context.options.effort

    def unsure(reached: Reached) -> bool:
        all_tried = reached.iterations.get(StageName.SEARCH, 0) >= PATIENCE[effort].improved
        return all_tried and StageName.HORIZONS not in reached.marks and believed(reached)

    def make(reached: Reached) -> Stage:
        engine, patience = context.engine(released, 0.0), WITH_STARTS[effort]
        return Search(
            engine,
            None,
            context.seed,
            effort,
            patience=patience,
            name=StageName.SEARCH_STARTS,
            drawn=drawn,
            finer=lambda: context.engine(released, 0.0, 0.5),
        )

    return Planned(StageName.SEARCH_STARTS, WITH_STARTS[effort].improved, make, unsure)


ONLY_SEGMENTS = (
    "whole solutions were not followed from any start: the constants are those of segments with initial states of "
    "their own, of at most {rows} intervals between rows; to have intervals and a fit that comes to rest, cut the "
    "trajectories into such pieces"
)
ONLY_BEGINNINGS = (
    "whole solutions were not followed from any start: the constants are those of the first {rows} intervals between "
    "rows of each trajectory, where solutions follow the data; to have intervals and a fit that comes to rest, fit "
    "these rows alone"
)
