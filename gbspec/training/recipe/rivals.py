"""The end of a search of least squares whose minima the likelihood judges: of counts, and of noises that are learned.

Least squares give all values of a channel the same weight. Minima that they do not tell apart may differ by tens in -2
log likelihood where the noise depends on the prediction, and the likelihood does not lead from one to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Engine
from gbspec.training.optimise import Outcome, State, equal
from gbspec.training.population import Exchanged, Pooled
from gbspec.training.problem import Parameters
from gbspec.training.starts import Search

ITERATIONS = 30
"""Largest number of iterations of the likelihood from each minimum."""


class JudgedSearch(Pooled):
    """The search, from whose minima, where there are several, the likelihood `of` is maximised in the last step.

    The highest maximum is taken; of those as high, the one nearest to the declared starting values. The others are
    named that the data do not tell from it.
    """

    def __init__(self, search: Search, engine: Engine, parameters: Parameters, of: Exchanged) -> None:
        super().__init__(search, engine, parameters)
        self.search, self.of = search, of

    def step(self, state: State, iteration: int) -> Outcome:
        """One step of the search."""
        outcome = super().step(state, iteration)
        if not outcome.done:
            return outcome
        inner = self.inner(outcome.state)
        rivals = [one for one, _ in self.search.rivals(inner, inner["theta"])]
        return self._judged(outcome, [inner["theta"], *rivals]) if rivals else outcome

    def _judged(self, outcome: Outcome, minima: Sequence[Array]) -> Outcome:
        """The end of the search at the maximum to which one of the minima leads."""
        before, of = outcome.state["theta"], self.of
        maxima = self._separate(
            [one for each in minima if (one := self._maximum(self.theta(each, before))) is not None]
        )
        if not maxima:
            return replace(outcome, note="")
        rises = np.array([of.objective(one) for one in maxima])
        rises -= rises.min()
        as_good = np.flatnonzero(rises <= equal.no_rise(of.count))
        places = np.array([of.maps.from_natural(of.values(maxima[i])) for i in as_good])
        taken = int(as_good[equal.nearest(places, of.maps.from_natural(of.declared))])
        alike = [i for i in range(len(maxima)) if i != taken and rises[i] <= equal.ALIKE]
        told = [(equal.listed(of.names, of.values(maxima[i])), float(rises[i])) for i in alike]
        state = outcome.state | {"theta": maxima[taken]["theta"]}
        return replace(outcome, state=state, note=equal.said_of_others(told, of.count))

    def _maximum(self, theta: Array) -> State | None:
        """The state of the likelihood after its iterations from a vector; None where it cannot be computed."""
        try:
            state = self.of.fit.begin(theta)
            for iteration in range(ITERATIONS):
                outcome = self.of.fit.step(state, iteration)
                state = outcome.state
                if outcome.done:
                    break
            return state if np.isfinite(self.of.objective(state)) else None
        except ComputationError:
            return None

    def _separate(self, maxima: Sequence[State]) -> list[State]:
        """The maxima without those that are the same as a higher one: no constant differs clearly, or half-way to it
        the likelihood is no lower."""
        kept: list[State] = []
        for one in sorted(maxima, key=self.of.objective):
            kept += [one] if all(self._apart(one, other) for other in kept) else []
        return kept

    def _apart(self, one: State, other: State) -> bool:
        of = self.of
        if not equal.differ(of.values(one), of.values(other)):
            return False
        highest = max(of.objective(one), of.objective(other))
        try:
            return not of.between(one, other) <= highest + equal.no_rise(of.count)
        except ComputationError:
            return True
