"""Sub-steps cut where doses of a learned lag arrive: the packing that the native kernel solves.

In it every dose arrives at the start of a sub-step. What `gbspec.training.doses` takes as parts of a sub-step are
sub-steps here, whose starts and lengths move with the lag.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gbspec.data.trajectories import Array
from gbspec.training.doses import arrival_times, arrivals
from gbspec.training.packing import NODES, Integers, Packed

if TYPE_CHECKING:
    from gbspec.training.problem import Problem


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


def placed(problem: Problem, constants: Tensor) -> Placed:
    """The packing of a problem, cut at the constants [N, n_constants]."""
    packed, doses = problem.packed, problem.packed.doses
    count = len(doses.time)
    layers = arrivals(problem, constants)
    time = arrival_times(problem, constants.detach().cpu()).numpy() if count else doses.time
    learned = ~np.array(doses.known, dtype=bool)[doses.kind]
    more = ((layers >= 0) & learned[layers]).sum(0) if count else np.zeros(packed.t.shape, dtype=np.int64)
    parts = np.where(np.arange(packed.depth)[:, None] < packed.steps, 1 + more, 0)
    first = np.concatenate([np.zeros((1, packed.trajectories), dtype=np.int64), np.cumsum(parts, 0)])
    repeated = _repeated(packed, parts, first) if more.any() else packed
    out = Placed(
        packed=repeated,
        step=np.full(count, -1, dtype=np.int64),
        following=np.full(count, -1, dtype=np.int64),
        cuts=np.zeros(count, dtype=np.bool_),
        slope=np.zeros((repeated.depth, repeated.trajectories, packed.inputs.shape[3])),
    )
    for step, owner in zip(*np.nonzero((layers >= 0).any(0)), strict=True):
        events = layers[:, step, owner]
        begins = _place(out, first[step, owner], packed.t[step, owner], events[events >= 0], time, learned)
        if len(begins) > 1:
            _cut(out, packed, step, owner, first[step, owner], begins)
    return out


def _repeated(packed: Packed, parts: Integers, first: Integers) -> Packed:
    """A packing with each sub-step [T, N] as often as it has parts, the first of them at `first` [T + 1, N]."""
    steps = first[-1]
    shape = (int(steps.max()), packed.trajectories)
    t, h, inputs = np.zeros(shape), np.zeros(shape), np.zeros((*shape, *packed.inputs.shape[2:]))
    for i, n in enumerate(packed.steps):
        whole = np.repeat(np.arange(n), parts[:n, i])
        for new, old in ((t, packed.t), (h, packed.h), (inputs, packed.inputs)):
            new[: len(whole), i] = old[whole, i]
    row_step = first[packed.row_step, packed.row_trajectory]
    return replace(packed, t=t, h=h, inputs=inputs, steps=steps, row_step=row_step)


def _place(
    out: Placed, part: int, start: float, events: Integers, time: Array, learned: NDArray[np.bool_]
) -> list[float]:
    """Places the doses that arrive in a sub-step, in the order of time, into its parts, from `part` on; gives when
    these begin, counted from the sub-step's start."""
    begins, last = [0.0], -1
    for event in events:
        if learned[event]:
            begins.append(float(time[event] - start))
        elif last >= 0:
            out.following[last] = event
        out.cuts[event], out.step[event] = learned[event], part + len(begins) - 1
        last = int(event)
    return begins


def _cut(out: Placed, packed: Packed, step: int, owner: int, part: int, begins: list[float]) -> None:
    """Sets times, lengths and inputs of a sub-step's parts."""
    start, length, nodes = packed.t[step, owner], packed.h[step, owner], packed.inputs[step, owner]
    slope = (nodes[-1] - nodes[0]) / (length if length > 0 else 1.0)
    for i, (begin, end) in enumerate(pairwise([*begins, length])):
        place = part + i, owner
        out.packed.t[place], out.packed.h[place], out.slope[place] = start + begin, end - begin, slope
        for k, node in enumerate(NODES):
            out.packed.inputs[(*place, k)] = nodes[0] + (begin + node * (end - begin)) * slope
