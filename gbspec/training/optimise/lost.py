"""The error of a fit whose filter has no finite moments."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.problem import measured_states


def not_finite(engine: FilterEngine, found: Filtered, stage: str) -> ComputationError:
    """The error for a vector at which the filter `found` is not finite: trajectory and time."""
    packed, legs = engine.problem.packed, engine.legs
    bad = np.flatnonzero(found.bad | ~np.isfinite(found.end_mean).all(axis=1))
    first = int(bad[0]) if len(bad) else 0
    owner = int(legs.owner[first])
    step = min(int(legs.first[first]), max(packed.depth - 1, 0))
    time = float(packed.t[step, owner]) if packed.depth else float(packed.start[owner])
    x = engine.coordinates.states(found.start_mean[first])
    fixed = engine.tolerance is None and engine.exact is None
    steps = "a smaller `--max-step`, `--solver ros34pw2` (for stiff equations), " if fixed else ""
    values = ", ".join(f"{s.name} = {v:.6g}" for s, v in zip(engine.problem.model.states, x, strict=True))
    measured, known = measured_states(engine.problem.model, packed)
    seen = known.any(axis=0)
    spread = np.logical_and((engine.start_variance > 0).any(axis=0), ~seen)
    names = [state.name for state, wide in zip(engine.problem.model.states, spread.tolist(), strict=True) if wide]
    learned = f"; `initial {names[0]} learn` takes the spread from its start, which nothing measures" if names else ""
    return ComputationError(
        f"the filter's moments are not finite in stage `{stage}`",
        where=f"trajectory `{packed.labels[owner]}` at {engine.problem.model.time.name} = {time:.6g}, where {values}",
        remedy=f"try {steps}bounds on the learned constants (`learn k = 1 in [0, 10]`), or a range and a start for "
        f"each state (`state x in [0, 1] = 0.5`){learned}{_without_coordinate(engine, owner, measured)}",
    )


def _without_coordinate(engine: FilterEngine, owner: int, measured: Array) -> str:
    """What helps where a trajectory's first measured value of a state has no logarithm or logit: beside it the state
    may change too fast for any step."""
    packed = engine.problem.packed
    (rows,) = np.nonzero((packed.row_trajectory == owner) & (packed.row_index == 0) & (packed.row_step == 0))
    states = zip(engine.problem.model.states, engine.coordinates.each, measured[rows[:1]].T, strict=True)
    for state, each, value in states:
        if len(value) and np.isfinite(value[0]) and each.inside(value)[0] != value[0]:
            kind = "logarithm" if each.logarithm else "logit"
            return (
                f"; the first value of `{state.name}`, {value[0]:.6g}, has no {kind}, "
                f"whose disturbance is the same everywhere: leave it empty, or write `initial {state.name} learn`"
            )
    return ""
