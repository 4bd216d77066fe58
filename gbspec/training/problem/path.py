"""The sub-steps at one vector: a packing in which every arrival lies between two sub-steps.

A dose given at d arrives at d + lag. Where the lag is learned, the sub-step that the arrival falls into is cut there,
and start and length of both parts depend on the lag. The solution then has the solver's full order and is
differentiable in the lag; the other sub-steps are unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.training.problem.arrivals import Integers
from gbspec.training.problem.mesh import Factors
from gbspec.training.problem.packing import Packed


@dataclass(frozen=True, eq=False)
class Path:
    """A packing, with sub-steps cut where necessary, in which all doses arrive at the starts of sub-steps.

    For each dose [E]: `time`, the time of arrival, `step`, the sub-step at whose start it arrives (-1: it does not),
    `following`, the next dose there (-1: none), and `cuts`, whether that start is its time of arrival. `slope` [T, N,
    n_inputs]: the slopes in time of the inputs in sub-steps that were cut. `factors`: the frozen matrices of the
    sub-steps, where the method has any.
    """

    packed: Packed
    time: Array
    step: Integers
    following: Integers
    cuts: NDArray[np.bool_]
    slope: Array
    factors: Factors | None = None

    @cached_property
    def doses(self) -> Integers:
        """The doses that arrive at the start of each sub-step [L, T, N], in the order of time; -1: none."""
        packed, owner = self.packed, self.packed.doses.owner
        order = _in_time(owner, self.step, self.time)
        cell = owner[order] * (packed.depth + 1) + self.step[order]
        rank = np.arange(len(order)) - np.searchsorted(cell, cell)
        out = np.full((int(rank.max(initial=-1)) + 1, packed.depth, packed.trajectories), -1, dtype=np.int64)
        out[rank, self.step[order], owner[order]] = order
        return out

    @cached_property
    def cutting(self) -> Integers:
        """The dose that determines the start of each sub-step and the end of the last one [T + 1, N]; -1: none."""
        out = np.full((self.packed.depth + 1, self.packed.trajectories), -1, dtype=np.int64)
        cutting = np.flatnonzero(self.cuts)
        out[self.step[cutting], self.packed.doses.owner[cutting]] = cutting
        return out


def path_of(packed: Packed, time: Array) -> Path:
    """The sub-steps of a packing whose doses arrive at `time` [E]."""
    doses, whole = packed.doses, _sub_step_of(packed, time)
    order = _in_time(doses.owner, whole, time)
    cell = doses.owner[order] * (packed.depth + 1) + whole[order]
    cuts = ~np.array(doses.known, dtype=np.bool_)[doses.kind] & (whole >= 0)
    parts = np.where(np.arange(packed.depth) < packed.steps[:, None], 1, 0)
    np.add.at(parts, (doses.owner[cuts], whole[cuts]), 1)
    first = np.concatenate([np.zeros((packed.trajectories, 1), dtype=np.int64), np.cumsum(parts, 1)], 1)
    # A dose that cuts begins a new part; the others arrive in the current part.
    begun = np.concatenate([[0], np.cumsum(cuts[order])])
    part = begun[1:] - begun[np.searchsorted(cell, cell)]
    step, following = (np.full(len(time), -1, dtype=np.int64) for _ in range(2))
    step[order] = first[doses.owner[order], whole[order]] + part
    together = np.flatnonzero((cell[1:] == cell[:-1]) & (part[1:] == part[:-1]))
    following[order[together]] = order[together + 1]
    if not cuts.any():
        return Path(packed, time, step, following, cuts, np.zeros((packed.depth, packed.trajectories, 0)))
    cut, slope = _cut(packed, parts, first, step, cuts, time)
    return Path(cut, time, step, following, cuts, slope)


def with_doses(path: Path, packed: Packed, index: Integers) -> Path:
    """The path with another packing of the same sub-steps, whose doses are those of the path at `index` [D]; of equal
    ones the first determines where a sub-step begins."""
    step, owner = path.step[index], packed.doses.owner
    order = _in_time(owner, step, path.time[index])
    cell, following = owner[order] * (packed.depth + 1) + step[order], np.full(len(index), -1, dtype=np.int64)
    together = np.flatnonzero(cell[1:] == cell[:-1])
    following[order[together]] = order[together + 1]
    first = np.zeros(len(index), dtype=np.bool_)
    first[np.unique(index, return_index=True)[1]] = True
    return replace(
        path, packed=packed, time=path.time[index], step=step, following=following, cuts=path.cuts[index] & first
    )


def _sub_step_of(packed: Packed, time: Array) -> Integers:
    """The sub-step that contains the time of arrival `time` [E] of each dose; -1: none.

    A time within rounding of a boundary belongs to the later sub-step. Doses that would arrive before a trajectory's
    start are ignored as already given; those at its end have no effect.
    """
    owner, out = packed.doses.owner, np.full(len(time), -1, dtype=np.int64)
    given = np.flatnonzero(np.isfinite(time) & (packed.steps[owner] > 0))
    given = given[np.argsort(owner[given], kind="stable")]
    whose, first = np.unique(owner[given], return_index=True)
    # Not strict: without doses `whose` is empty, but np.split still returns one (empty) array.
    for i, mine in zip(whose, np.split(given, first[1:]), strict=False):
        n = packed.steps[i]
        begins, end = packed.t[:n, i], packed.t[n - 1, i] + packed.h[n - 1, i]
        tolerance = 1e-9 * (end - begins[0])
        step = np.searchsorted(begins, time[mine] + tolerance, side="right") - 1
        inside = (time[mine] >= begins[0] - tolerance) & (time[mine] <= end - tolerance)
        out[mine] = np.where(inside, step, -1)
    return out


def _in_time(owner: Integers, step: Integers, time: Array) -> Integers:
    """The doses that arrive [A], trajectory by trajectory in the order of their sub-steps `step` and times."""
    order = np.lexsort((time, step, owner))
    return np.asarray(order[step[order] >= 0], dtype=np.int64)


def _cut(
    packed: Packed, parts: Integers, first: Integers, step: Integers, cuts: NDArray[np.bool_], time: Array
) -> tuple[Packed, Array]:
    """The packing with its sub-steps in `parts` [N, T], of which the first are `first` [N, T + 1], and the slopes of
    inputs in them; the sub-steps `step` [E] of doses that cut begin at their `time`."""
    steps = first[:, -1]
    owner, old = (np.repeat(index.ravel(), parts.ravel()) for index in np.indices(parts.shape))
    new = np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps)
    shape = (int(steps.max()), packed.trajectories)
    start, begin, end = (np.zeros(shape) for _ in range(3))  # of the whole sub-step; of the part, relative to its start
    start[new, owner], end[new, owner] = packed.t[old, owner], packed.h[old, owner]
    who = packed.doses.owner[cuts]
    moved = time[cuts] - start[step[cuts], who]
    begin[step[cuts], who] = end[step[cuts] - 1, who] = moved
    inputs, slope = np.zeros((*shape, *packed.inputs.shape[2:])), np.zeros((*shape, packed.inputs.shape[3]))
    inputs[new, owner] = packed.inputs[old, owner]
    several = parts[owner, old] > 1
    place, length = (new[several], owner[several]), packed.h[old, owner][several]
    nodes = inputs[place]
    slope[place] = (nodes[:, -1] - nodes[:, 0]) / np.where(length > 0, length, 1.0)[:, None]
    share = begin[place][:, None] + np.array(packed.nodes) * (end - begin)[place][:, None]
    inputs[place] = nodes[:, :1] + share[:, :, None] * slope[place][:, None]
    row_step = first[packed.row_trajectory, packed.row_step]
    return replace(packed, t=start + begin, h=end - begin, inputs=inputs, steps=steps, row_step=row_step), slope
