"""Where models with unknown functions have events with learned conditions: a search for these constants.

A threshold that no solution reaches has no derivative, and neither has one that none passes any more: from such a start
no stage finds it. As for known functions, constants are drawn from their whole ranges, and the best draws are improved,
together with the weights, for a few iterations each. Predictions from one row to the next are compared: they have fewer
minima than whole solutions, and show an event by what it does to the next rows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.training.engines import Engine
from gbspec.training.optimise import LevenbergOptions, State
from gbspec.training.stages import Effort
from gbspec.training.starts import Patience, Search

ITERATIONS = 20
"""Largest number of iterations from one start."""
PATIENCE: Mapping[Effort, Patience] = {
    "low": Patience(64, 24, 16, 2),
    "normal": Patience(128, 48, 24, 3),
    "high": Patience(256, 96, 48, 4),
}


def learned_thresholds(model: Model) -> list[str]:
    """The learnable constants in the conditions of events that have effects (others end steps at switches)."""
    guards = [event.guard for event in model.events if event.guard is not None and event.values]
    symbols = set().union(*(guard.free_symbols for guard in guards))
    return [one.name for one in model.learnables if one.symbol in symbols]


class ThresholdSearch(Search):
    """The search for constants of events beside networks, whose weights start from those of the warm start.

    `random` gives the vector with other random weights, by a number.
    """

    def __init__(
        self,
        engine: Engine,
        seed: int,
        effort: Effort,
        options: LevenbergOptions,
        random: Callable[[Array, int], Array],
    ) -> None:
        super().__init__(engine, None, seed, effort, patience=PATIENCE[effort])
        self.options, self.iterations, self.random = options, ITERATIONS, random

    def _candidates(self, theta: Array) -> Array:
        """Half of the draws with other weights: those of the warm start may be in a wrong minimum."""
        out = super()._candidates(theta)
        n = self.parameters.n_weights
        for i in range(2 + (len(out) - 2) // 2, len(out)):
            out[i, :n] = self.random(theta, i)[:n]
        return out

    def _preferred(self, minima: State, theta: Array, best: float) -> Array:
        """The best one: weights have not come to rest, so that none is known to be a minimum."""
        return theta

    def _others(self, minima: State, theta: Array) -> str:
        return ""
