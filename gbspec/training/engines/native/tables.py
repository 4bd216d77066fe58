"""A problem's data in the native kernel's format."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gbspec.backends import Library, Struct
from gbspec.ir import Model
from gbspec.training.problem import Integers, Path, Problem, band_of


class Tables:
    """A problem's data on a path."""

    def __init__(self, problem: Problem, path: Path) -> None:
        self.path, packed = path, path.packed
        row_at = np.full((packed.trajectories, packed.depth + 1), -1, dtype=np.int32)
        row_at[packed.row_trajectory, packed.row_step] = np.arange(packed.rows)
        arrays = {
            # Data that are read step by step are contiguous for each trajectory.
            "t": packed.t.T,
            "h": packed.h.T,
            "inputs": packed.inputs.swapaxes(0, 1),
            "condition": packed.condition,
            "steps": packed.steps,
            "row_at": row_at,
            "row_time": packed.row_time,
            "row_inputs": packed.row_inputs,
            "measured": problem.measured,
            "factor": problem.factor,
            "value": problem.forcing.value,
            "weight": problem.forcing.weight,
            "band": np.array([band_of(problem)]) if problem.model.events else None,
            "begin": packed.start if problem.model.delays else None,
            "before": packed.inputs_before if problem.model.delays else None,
            "logarithmic": problem.scaling.log.astype(np.int32),
            "sizes": problem.scaling.sizes,
            "side": None if problem.censored is None else problem.censored.side.astype(np.int32),
            "level": None if problem.censored is None else problem.censored.level.astype(np.float64),
            **_arrivals(problem.model, path),
            "lu": None if path.factors is None else path.factors.lu.swapaxes(0, 1),
            "pivots": None if path.factors is None or not path.factors.whole else path.factors.pivots.swapaxes(0, 1),
        }
        self._arrays = {name: None if a is None else np.ascontiguousarray(a) for name, a in arrays.items()}
        self._data: tuple[Library, Struct] | None = None
        self._forced = bool(problem.forcing.weight.any())
        self.packed, self.arrivals = packed, len(packed.doses.time)
        self.shape = (packed.rows, len(problem.model.channels))
        self.states = len(problem.model.states)
        self.steps, self.depth = packed.steps, packed.depth
        # Trajectories of about the same number of steps share a tile.
        self.order = np.argsort(-packed.steps, kind="stable").astype(np.int64)

    def data(self, library: Library) -> Struct:
        """The data for a kernel of the model, kept between calls."""
        if self._data is None or self._data[0] is not library:
            sizes = {"depth": self.depth, "trajectories": self.packed.trajectories, "forced": int(self._forced)}
            self._data = library, library.struct("Data", **sizes, **self._arrays)
        return self._data[1]

    @cached_property
    def arrival_row(self) -> Integers:
        """The key row at the end of the interval in which each dose arrives [E]; -1: none."""
        packed, step = self.packed, self.path.step
        owner, wide = packed.doses.owner, packed.depth + 2
        row = np.lexsort((packed.row_step, packed.row_trajectory))
        reached = packed.row_trajectory[row] * wide + packed.row_step[row]
        place = np.searchsorted(reached, owner * wide + step, side="right")
        found = np.append(row, 0)[np.minimum(place, len(row))]
        lies = (step >= 0) & (place < len(row)) & (np.append(packed.row_trajectory[row], -1)[place] == owner)
        return np.where(lies, found, -1)


def _arrivals(model: Model, places: Path) -> dict[str, NDArray[np.generic] | None]:
    """Doses at the starts of sub-steps."""
    packed, step = places.packed, places.step
    if not len(step):
        return dict.fromkeys(("arrival_at", "arrival_next", "arrival_state", "arrival_cuts", "slope"))
    first = np.full((packed.trajectories, packed.depth), -1, dtype=np.int32)
    heads = np.setdiff1d(np.flatnonzero(step >= 0), places.following)
    first[packed.doses.owner[heads], step[heads]] = heads
    # Arrivals of nothing, at which steps begin because of delays, come after the kinds of doses.
    state = np.zeros(1 + int(packed.doses.kind.max()), dtype=np.int32)
    state[: len(model.doses)] = [model.state_index[dose.state] for dose in model.doses]
    return {
        "arrival_at": first,
        "arrival_next": places.following.astype(np.int32),
        "arrival_state": state[packed.doses.kind],
        "arrival_cuts": places.cuts.astype(np.int32),
        "slope": places.slope.swapaxes(0, 1) if places.cuts.any() else None,
    }
