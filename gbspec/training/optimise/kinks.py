"""Times of events that rest at a kink: an objective has one where such a time passes a row, another event or a knot.

There the slopes on the two sides differ. Where the objective rises to both, the time is at a minimum although no
derivative vanishes, and a joint step, which has the slope of one side, leads across: damped until it leads nowhere, it
leaves the other entries unfinished. So these are fitted with such a time held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Linearised
from gbspec.training.optimise.past_events import Passing
from gbspec.training.optimise.stage import State
from gbspec.training.problem import Parameters

STEP = 1e-3
"""The larger distance at which the slopes are compared, on the scale of training."""
PART = 8.0
"""The smaller one is this part of it: the sum of the slopes to both sides stays at a kink, falls by this factor at a
smooth minimum, and rises by it at a jump."""
SEEN = 1e-9
"""The least rise, as a part of the objective, that is told from errors of rounding."""
HELD, LEFT = 1.0, 2.0
"""Marks of entries that are held at a kink, and of those that were, until the rest of the fit moved the minimum away:
these are free, and not held again, so that a stage comes to its end."""


def at_kinks(value: Callable[[Array], float], theta: Array, entries: Sequence[int]) -> list[int]:
    """Those of the `entries` of a vector at whose kink the objective `value` rises to both sides."""
    found = list[int]()
    here = value(theta) if entries else 0.0
    for entry in entries:
        sums = list[float]()
        for step in (STEP, STEP / PART):
            sides = np.tile(theta, (2, 1))
            sides[:, entry] += (-step, step)
            rises = np.array([value(side) - here for side in sides])
            if not rises.min() > SEEN * abs(here):
                break
            sums.append(float(rises.sum()) / step)
        if len(sums) == 2 and 0.5 * sums[0] < sums[1] < 2 * sums[0]:
            found.append(entry)
    return found


def held_at_kinks(state: State, parameters: Parameters, value: Callable[[Array], float]) -> State:
    """What changes in the `state` of a stage that has come to its end: the marks `held` [size] of entries; empty where
    these stay as they are."""
    theta = state["theta"]
    entries = Passing.of(parameters.model, parameters).entries
    before = state.get("held", np.zeros(len(theta)))
    held = np.where(before == HELD, LEFT, before)
    for entry in at_kinks(value, theta, entries):
        held[entry] = HELD if before[entry] != LEFT else LEFT
    return {} if np.array_equal(held, before) else {"held": held}


def without_held(system: Linearised, parameters: Parameters, held: Array | None) -> Linearised:
    """The linearised problem in which no step changes the entries with the mark `HELD`; its arrays change in place."""
    for entry in np.flatnonzero(held == HELD) if held is not None else ():
        if entry < parameters.n_shared:
            system.shared[:, entry] = 0.0
        else:
            owner, place = divmod(int(entry) - parameters.n_shared, parameters.n_local)
            system.local[system.owner == owner, place] = 0.0
    return system


__all__ = ["at_kinks", "held_at_kinks", "without_held"]
