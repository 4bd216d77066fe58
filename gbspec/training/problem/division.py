"""The division of a path's sub-steps into the steps that were accepted at a vector."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.training.problem.arrivals import Integers
from gbspec.training.problem.mesh import Factors, Steps
from gbspec.training.problem.path import Path


def meshed(path: Path, steps: Steps) -> Path:
    """The path whose sub-steps are divided into these steps; cells without any are one step."""
    packed = path.packed
    steps = _completed(path, steps)
    order = np.lexsort((steps.begin, steps.cell, steps.owner))
    owner, cell, begin, length = (getattr(steps, name)[order] for name in ("owner", "cell", "begin", "length"))
    parts = np.zeros((packed.trajectories, packed.depth), dtype=np.int64)
    np.add.at(parts, (owner, cell), 1)
    first = np.concatenate([np.zeros((packed.trajectories, 1), dtype=np.int64), np.cumsum(parts, 1)], 1)
    count = first[:, -1]
    new = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    shape = (int(count.max(initial=0)), packed.trajectories)
    t, h = np.zeros(shape), np.zeros(shape)
    inputs = np.zeros((*shape, *packed.inputs.shape[2:]))
    slope = np.zeros((*shape, path.slope.shape[2]))
    t[:] = packed.start + 0.0
    t[new, owner], h[new, owner] = packed.t[cell, owner] + begin, length
    inputs[new, owner] = _inputs(path, owner, cell, begin, length)
    slope[new, owner] = path.slope[cell, owner]
    row_step = first[packed.row_trajectory, packed.row_step]
    made = replace(packed, t=t, h=h, inputs=inputs, steps=count, row_step=row_step)
    arrives = np.where(path.step >= 0, first[packed.doses.owner, np.maximum(path.step, 0)], -1)
    factors = None
    if steps.lu.shape[1]:
        n, exchanged = steps.lu.shape[1], steps.pivots.shape[1]
        lu, pivots = np.broadcast_to(np.eye(n), (*shape, n, n)).copy(), np.zeros((*shape, exchanged), dtype=np.int32)
        pivots[:] = np.arange(1, exchanged + 1)
        lu[new, owner], pivots[new, owner] = steps.lu[order], steps.pivots[order]
        factors = Factors(lu, pivots)
    return replace(path, packed=made, step=arrives, slope=slope, factors=factors)


def _completed(path: Path, steps: Steps) -> Steps:
    """The steps, with one for each cell that has none."""
    packed = path.packed
    given = np.zeros((packed.depth, packed.trajectories), dtype=bool)
    given[steps.cell, steps.owner] = True
    cell, owner = np.nonzero(~given & (np.arange(packed.depth)[:, None] < packed.steps))
    n, count = steps.lu.shape[1], len(cell)
    lu = np.broadcast_to(np.eye(n), (count, n, n))
    exchanged = steps.pivots.shape[1]
    pivots = np.broadcast_to(np.arange(1, exchanged + 1, dtype=np.int32), (count, exchanged))
    return Steps.joined([steps, Steps(owner, cell, np.zeros(count), packed.h[cell, owner], lu, pivots)])


def _inputs(path: Path, owner: Integers, cell: Integers, begin: Array, length: Array) -> Array:
    """The inputs at the nodes of steps in cells, in which they are linear in time [A, nodes, n_inputs]."""
    packed = path.packed
    given = packed.inputs[cell, owner]
    whole = (begin == 0) & (length == packed.h[cell, owner])
    share = (begin[:, None] + np.array(packed.nodes) * length[:, None]) / np.maximum(packed.h[cell, owner], 1e-300)[
        :, None
    ]
    inside = given[:, :1] + share[:, :, None] * (given[:, -1:] - given[:, :1])
    return np.asarray(np.where(whole[:, None, None], given, inside), dtype=np.float64)
