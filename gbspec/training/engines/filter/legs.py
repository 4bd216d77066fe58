"""The legs of trajectories: the parts between two points at which the filter's moments are needed.

A leg is a sub-step, or nothing before a key row at the start; at the end of some there is a key row, where measurements
update the moments. Legs are ordered by their place within their trajectory, then by trajectory; trajectories by
decreasing number of legs, so that those with a leg at a place come first.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

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

    @cached_property
    def place(self) -> Integers:
        """The place of each leg within its trajectory [B]."""
        return np.repeat(np.arange(self.places), np.diff(self.begins))

    def at(self, place: int) -> slice:
        """The legs at a place."""
        return slice(int(self.begins[place]), int(self.begins[place + 1]))

    def rows_of(self, index: Integers) -> tuple[Integers, Integers]:
        """The rows at the ends of legs that have one, and the place of each leg's row among them (-1: none)."""
        ends = np.flatnonzero(self.row[index] >= 0)
        place = np.full(len(index), -1, dtype=np.int64)
        place[ends] = np.arange(len(ends))
        return self.row[index[ends]], place


def legs_of(problem: Problem) -> Legs:
    """The legs of a problem."""
    packed = problem.packed
    found: list[list[tuple[int, int, int]]] = []
    for i in range(packed.trajectories):
        rows = np.flatnonzero(packed.row_trajectory == i)
        mine: list[tuple[int, int, int]] = []
        at = 0
        for row in rows[np.argsort(packed.row_index[rows])]:
            end = int(packed.row_step[row])
            if end > at:
                mine += [(step, 1, -1) for step in range(at, end - 1)] + [(end - 1, 1, int(row))]
            else:
                mine.append((at, 0, int(row)))
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
    """The sub-steps of B legs.

    Starts `t` and lengths `h` [B], inputs at the method's nodes [B, nodes, n_inputs], the amounts of doses that arrive
    at their starts [B, kinds], conditions [B, n_conditions].
    """

    t: Array
    h: Array
    inputs: Array
    doses: Array
    condition: Array


def steps_of(path: Path, owner: Integers, number: Integers) -> Steps:
    """The sub-steps `number` of the trajectories `owner` [B]."""
    packed = path.packed
    doses = dose_amounts(path)[number, owner]
    at = (number, owner)
    return Steps(packed.t[at], packed.h[at], packed.inputs[at], doses, packed.condition[owner])


def dose_amounts(path: Path) -> Array:
    """The amounts of each kind of dose that arrive at the start of each sub-step [T, N, kinds]."""
    packed, doses = path.packed, path.packed.doses
    out = np.zeros((packed.depth, packed.trajectories, len(doses.known)))
    mine = path.step >= 0
    np.add.at(out, (path.step[mine], doses.owner[mine], doses.kind[mine]), doses.amount[mine])
    return out
