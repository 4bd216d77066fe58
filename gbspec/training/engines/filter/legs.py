"""The legs of trajectories: the parts between two points at which the filter's moments are needed.

A leg ends at a key row, where measurements update the moments, or (in models whose legs are solved exactly) at the end
of a sub-step. Legs are ordered by their place within their trajectory, then by trajectory; trajectories by decreasing
number of legs, so that those with a leg at a place come first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.training.problem import Integers, Path, Problem


@dataclass(frozen=True)
class Legs:
    """B legs in L places of N trajectories.

    `rank` [N]: the trajectories in their order; for each leg [B] its trajectory `owner`, its first sub-step `first`,
    the number of sub-steps `count` (0: a row at the start), and the key row `row` at its end (-1: none). `begins`
    [L + 1]: the first leg at each place.
    """

    rank: Integers
    owner: Integers
    first: Integers
    count: Integers
    row: Integers
    begins: Integers

    @property
    def places(self) -> int:
        """The number of legs of the longest trajectory."""
        return len(self.begins) - 1

    def at(self, place: int) -> slice:
        """The legs at a place."""
        return slice(int(self.begins[place]), int(self.begins[place + 1]))


def legs_of(problem: Problem, single: bool) -> Legs:
    """The legs of a problem: one for each interval between key rows, or with `single` one for each sub-step."""
    packed = problem.packed
    found: list[list[tuple[int, int, int]]] = []
    for i in range(packed.trajectories):
        rows = np.flatnonzero(packed.row_trajectory == i)
        mine: list[tuple[int, int, int]] = []
        at = 0
        for row in rows[np.argsort(packed.row_index[rows])]:
            end = int(packed.row_step[row])
            if single and end > at:
                mine += [(step, 1, -1) for step in range(at, end - 1)] + [(end - 1, 1, int(row))]
            else:
                mine.append((at, end - at, int(row)))
            at = end
        found.append(mine)
    rank = np.argsort([-len(mine) for mine in found], kind="stable").astype(np.int64)
    table, begins = [], [0]
    for place in range(max((len(mine) for mine in found), default=0)):
        table += [(int(i), *found[i][place]) for i in rank if len(found[i]) > place]
        begins.append(len(table))
    columns = np.array(table, dtype=np.int64).reshape(-1, 4).T
    owner, first, count, row = columns
    return Legs(rank, owner, first, count, row, np.array(begins, dtype=np.int64))


@dataclass(frozen=True)
class Steps:
    """The sub-steps of B legs, padded with sub-steps of length zero to the same number D.

    Starts `t` and lengths `h` [B, D], inputs at the method's nodes [B, D, nodes, n_inputs], the amounts of doses that
    arrive at their starts [B, D, kinds], conditions [B, n_conditions].
    """

    t: Array
    h: Array
    inputs: Array
    doses: Array
    condition: Array


def steps_of(path: Path, owner: Integers, first: Integers, count: Integers, depth: int) -> Steps:
    """The sub-steps `first` to `first + count` of the trajectories `owner` [B], padded to `depth`."""
    packed = path.packed
    number = first[:, None] + np.arange(depth)
    inside = np.arange(depth) < count[:, None]
    last = np.minimum(number, np.maximum(first + count - 1, 0)[:, None])
    last = np.clip(last, 0, max(packed.depth - 1, 0))
    who = np.broadcast_to(owner[:, None], last.shape)
    if not packed.depth:
        shape = (*last.shape, len(packed.nodes), packed.inputs.shape[3])
        zero = np.zeros(last.shape)
        return Steps(zero, zero, np.zeros(shape), np.zeros((*last.shape, 0)), packed.condition[owner])
    doses = np.where(inside[:, :, None], dose_amounts(path)[last, who], 0.0)
    h = np.where(inside, packed.h[last, who], 0.0)
    return Steps(packed.t[last, who], h, packed.inputs[last, who], doses, packed.condition[owner])


def dose_amounts(path: Path) -> Array:
    """The amounts of each kind of dose that arrive at the start of each sub-step [T, N, kinds]."""
    packed, doses = path.packed, path.packed.doses
    out = np.zeros((packed.depth, packed.trajectories, len(doses.known)))
    mine = path.step >= 0
    np.add.at(out, (path.step[mine], doses.owner[mine], doses.kind[mine]), doses.amount[mine])
    return out


def buckets(count: Integers) -> list[tuple[int, Integers]]:
    """Legs of similar numbers of sub-steps: each a number to which they are padded, and their indices."""
    size = np.where(count > 0, 2 ** np.ceil(np.log2(np.maximum(count, 1))).astype(np.int64), 0)
    found = []
    for each in np.unique(size):
        index = np.flatnonzero(size == each)
        found.append((int(count[index].max(initial=0)), index))
    return found
