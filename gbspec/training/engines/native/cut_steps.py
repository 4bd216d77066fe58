"""Sub-steps cut where doses of a learned lag arrive: the packing that the native kernel solves.

In it every dose arrives at the start of a sub-step. What `engines.torch.doses` takes as parts of a sub-step are
sub-steps here, whose starts and lengths move with the lag.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gbspec.data.trajectories import Array
from gbspec.training.engines.torch.doses import in_order
from gbspec.training.problem.packing import Integers, Packed


@dataclass(frozen=True)
class Placed:
    """A packing whose doses all arrive at the starts of sub-steps, some of which they have cut.

    Of each dose [E]: `step`, the sub-step at whose start it arrives (-1: it does not), `following`, the dose after it
    there (-1: none), and `cuts`, whether it moves that start. `slope` [T, N, n_inputs]: the inputs' slopes in time in
    sub-steps that were cut.
    """

    packed: Packed
    step: Integers
    following: Integers
    cuts: NDArray[np.bool_]
    slope: Array


def placed(packed: Packed, time: Array) -> Placed:
    """A packing with its doses where they arrive, at `time` [E]."""
    doses, (whole, order, cell) = packed.doses, in_order(packed, time)
    cuts = ~np.array(doses.known, dtype=np.bool_)[doses.kind] & (whole >= 0)
    parts = np.where(np.arange(packed.depth) < packed.steps[:, None], 1, 0)
    np.add.at(parts, (doses.owner[cuts], whole[cuts]), 1)
    first = np.concatenate([np.zeros((packed.trajectories, 1), dtype=np.int64), np.cumsum(parts, 1)], 1)
    # A dose that cuts begins a part, others arrive in the one that has begun.
    begun = np.concatenate([[0], np.cumsum(cuts[order])])
    part = begun[1:] - begun[np.searchsorted(cell, cell)]
    step, following = (np.full(len(time), -1, dtype=np.int64) for _ in range(2))
    step[order] = first[doses.owner[order], whole[order]] + part
    together = np.flatnonzero((cell[1:] == cell[:-1]) & (part[1:] == part[:-1]))
    following[order[together]] = order[together + 1]
    if not cuts.any():
        return Placed(packed, step, following, cuts, np.zeros((packed.depth, packed.trajectories, 0)))
    cut, slope = _cut(packed, parts, first, step, cuts, time)
    return Placed(cut, step, following, cuts, slope)


def _cut(
    packed: Packed, parts: Integers, first: Integers, step: Integers, cuts: NDArray[np.bool_], time: Array
) -> tuple[Packed, Array]:
    """The packing with its sub-steps in `parts` [N, T], of which the first are `first` [N, T + 1], and the slopes of
    inputs in them; the sub-steps `step` [E] of doses that cut begin at their `time`."""
    steps = first[:, -1]
    owner, old = (np.repeat(index.ravel(), parts.ravel()) for index in np.indices(parts.shape))
    new = np.arange(len(owner)) - np.repeat(np.cumsum(steps) - steps, steps)
    shape = (int(steps.max()), packed.trajectories)
    start, begin, end = (np.zeros(shape) for _ in range(3))  # of a whole sub-step; of a part, counted from there
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
