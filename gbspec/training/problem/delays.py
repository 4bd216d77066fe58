"""Delays in a packing: how long steps may be, and where what jumped at a time shows again.

At the start of a trajectory the rate of change jumps, and so it does at times that the model gives (`if(t > 5, …)`); at
doses the state does. A time tau later, the jump shows in
whatever depends on the delayed state, another tau later in its next derivative, and so on. Steps begin there, so that
the solver keeps its order; since these times move with learned delays, they are arrivals like doses with learned lags.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Trajectories, Trajectory
from gbspec.diagnostics import ComputationError
from gbspec.ir import Expr, Model, delayed_inputs
from gbspec.passes import greatest_value, least_value

ORDER = 4
"""So many delays after a jump no derivative that the solver's order needs is discontinuous any more."""
MOST = 20
"""Most sums of delays that are followed."""


@dataclass(frozen=True)
class Echo:
    """A kind of times at which steps begin: jumps of one origin, some delays later.

    `dose` is the dose of the model that jumps, None for the start, the changes of inputs and the times at which right
    sides jump by themselves; `lags` the indices of the delays, with repetitions.
    """

    dose: int | None
    lags: tuple[int, ...]


def lags_of(model: Model) -> list[Expr]:
    """The times of the model's delays, each once, in the order of the generated module."""
    return list(dict.fromkeys(delay.lag for delay in model.delays))


def echoes(model: Model) -> list[Echo]:
    """The kinds of times at which steps begin, in a fixed order."""
    count = len(lags_of(model))
    sums: list[tuple[int, ...]] = []
    for size in range(1, ORDER + 1) if count else ():
        more = list(combinations_with_replacement(range(count), size))
        if sums and len(sums) + len(more) > MOST:
            break
        sums += more
    origins: list[int | None] = [None, *range(len(model.doses))]
    return [Echo(origin, lags) for origin in origins for lags in sums]


def jumps(item: Trajectory, model: Model, echo: Echo, switches: Array) -> Array:
    """The times at which what an echo repeats happened; `switches`: those at which the model itself jumps."""
    if echo.dose is not None:
        return np.asarray(item.doses[echo.dose].times, dtype=np.float64)
    found = [np.array([item.start]), switches]
    for place in delayed_inputs(model):
        times = np.asarray(item.inputs[place].times, dtype=np.float64)
        found.append(times[times > item.start])
    return np.unique(np.concatenate(found))


def looked_back(item: Trajectory, model: Model) -> float:
    """How far before its start the delays of a trajectory look at most; its own length where bounds do not say."""
    given = dict(zip((c.name for c in model.conditions), map(float, item.condition), strict=True))
    longest = max((greatest_value(model, lag, given) for lag in lags_of(model)), default=0.0)
    return longest if np.isfinite(longest) else item.end - item.start


def largest_steps(trajectories: Trajectories, model: Model, max_step: float) -> Iterator[float]:
    """For each trajectory the largest step: no longer than its shortest delay can become.

    Raises ComputationError for a delay that is not positive under the conditions of a trajectory.
    """
    lags = lags_of(model)
    for item in trajectories.items:
        given = dict(zip((c.name for c in model.conditions), map(float, item.condition), strict=True))
        least = min((least_value(model, lag, given) for lag in lags), default=np.inf)
        if not least > 0:
            raise ComputationError(
                f"a delay can be {least:.6g} under the conditions of the trajectory, and it must be positive",
                where=f"trajectory `{item.label}`",
                remedy="check the conditions, or give the learned constants in the delay higher lower bounds",
            )
        yield min(max_step, least)
