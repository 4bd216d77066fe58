"""A stage that may run, and what has been reached when it is decided."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Estimated
from gbspec.training.engines import Engine
from gbspec.training.optimise import Stage
from gbspec.training.stages import StageName


@dataclass(frozen=True)
class Reached:
    """The progress of a fit: the vector, the vectors at the ends of the previous stages, by their names, the names of
    all stages that have begun, the ridge and the damping of the last one that had any (0: none), how many
    iterations each stage took, and whether a likelihood is at its maximum."""

    theta: Array
    marks: Mapping[str, Array] = field(default_factory=dict)
    begun: Sequence[str] = ()
    ridge: float = 0.0
    damping: float = 0.0
    iterations: Mapping[str, int] = field(default_factory=dict)
    maximum: bool = False


Decision = Callable[[Reached], bool]
At = Callable[[int], Engine]


def always(reached: Reached) -> bool:
    """The decision of stages that run for all data."""
    return True


@dataclass(frozen=True)
class Planned:
    """A stage that may run: `make` builds it when its predecessors have ended.

    Two decisions are made at the same time: `wanted`, whether the data call for the stage, and `possible`, whether the
    stage has anything to do. `weigh` gives the noise by which channels are weighed from this stage on; without it they
    keep their weights.
    """

    name: StageName
    total: int
    make: Callable[[Reached], Stage]
    wanted: Decision = always
    possible: Decision = always
    weigh: Callable[[Reached], Estimated | None] | None = None

    def due(self, reached: Reached) -> bool:
        """Whether the stage runs."""
        return self.possible(reached) and self.wanted(reached)


def left_for_intervals(marks: Mapping[str, Array]) -> Array | None:
    """The fit of whole solutions, if that of single intervals was kept in its place and is the last one."""
    if StageName.CHOICE not in marks or StageName.WHOLE in marks:
        return None
    whole = marks[StageName.WEIGHTS if StageName.WEIGHTS in marks else StageName.AUTOREGRESSIVE]
    return None if np.array_equal(marks[StageName.CHOICE], whole) else whole


def shortened(begun: Sequence[str]) -> float:
    """The fraction of the largest step that stages of whole solutions use after the begun ones, which may have shown
    that a longer one is not stable."""
    return float(0.5 ** list(begun).count(StageName.SHORTER))


def step_fraction(begun: Sequence[str]) -> float:
    """The fraction of the largest step that the last of the begun stages uses."""
    later = {StageName.SHORTER, StageName.BLEND, StageName.AUTOREGRESSIVE} & set(begun)
    first = 0.5 if StageName.HALF_STEP in begun and not later else 1.0
    return float(first * shortened(begun) * 0.5 ** list(begun).count(StageName.FINER))
