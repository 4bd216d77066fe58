"""Trajectories that share standard numbers, since a column of the table groups them.

Each trajectory has q + E numbers: those of its own deviations, and one for each deviation of a level
(`Layout.levels`), which all trajectories with the same value of the level's column share. Trajectories that are
connected by shared numbers form a unit: the joint density of its measured values is integrated over all numbers of the
unit together. Without levels each trajectory is a unit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.population.layout import Layout
from gbspec.training.problem import Integers

TOGETHER = 1_000_000
"""Units are processed together up to so many numbers of matrices with a row and a column for each of their values."""


@dataclass(frozen=True)
class Groups:
    """`unit` [N]: the unit of each trajectory; `slot` [N, q + E]: the place of each of its numbers among the `size` of
    its unit. Units with fewer numbers have further ones that nothing depends on."""

    unit: Integers
    slot: Integers
    count: int
    size: int
    shared: bool

    @classmethod
    def of(cls, layout: Layout, condition: Array) -> Groups:
        """The groups of trajectories with these conditions [N, conditions]."""
        number, own = len(condition), layout.effects
        if not layout.levels:
            return cls(np.arange(number), np.tile(np.arange(own), (number, 1)), number, own, False)
        names = [c.name for c in layout.model.conditions]
        values = [
            np.unique(condition[:, names.index(level.column)], return_inverse=True)[1] for _, level in layout.levels
        ]
        unit = _connected(values, number)
        slot, used = np.zeros((number, own + len(values)), dtype=np.int64), np.zeros(unit.max() + 1, dtype=np.int64)
        known: dict[tuple[int, int], int] = {}
        for n, u in enumerate(unit.tolist()):
            slot[n, :own] = used[u] + np.arange(own)
            used[u] += own
            for e, value in enumerate(values):
                key = e, int(value[n])
                if key not in known:
                    known[key] = int(used[u])
                    used[u] += 1
                slot[n, own + e] = known[key]
        return cls(unit, slot, int(unit.max()) + 1, int(used.max()), True)

    def copies(self, count: int) -> Groups:
        """The groups of `count` copies of all trajectories, one after the other; copies share nothing."""
        unit = np.arange(count)[:, None] * self.count + self.unit
        return Groups(unit.ravel(), np.tile(self.slot, (count, 1)), count * self.count, self.size, self.shared)

    def numbers(self, z: Tensor) -> Tensor:
        """The numbers [N, q + E] of trajectories from those of units [units, size]."""
        return z[torch.from_numpy(self.unit)[:, None], torch.from_numpy(self.slot)] if self.shared else z

    def together(self, numbers: Array) -> Array:
        """The numbers of units [units, size] from those of trajectories: of shared ones the mean."""
        if not self.shared:
            return numbers
        total, count = np.zeros((self.count, self.size)), np.zeros((self.count, self.size))
        np.add.at(total, (self.unit[:, None], self.slot), numbers)
        np.add.at(count, (self.unit[:, None], self.slot), 1.0)
        return np.asarray(total / np.maximum(count, 1.0), dtype=np.float64)

    def placed(self, by: Tensor, owner: Tensor) -> Tensor:
        """Derivatives [m, size] by the numbers of units from those [m, q + E] by those of the trajectories `owner`."""
        if not self.shared:
            return by
        slot = torch.from_numpy(self.slot)[owner]
        return by.new_zeros((len(by), self.size)).scatter_add(1, slot, by)

    def of_trajectories(self, matrix: Array) -> Array:
        """The rows and columns [N, q + E, q + E] of the units' matrices [units, size, size]."""
        if not self.shared:
            return matrix
        return np.asarray(matrix[self.unit[:, None, None], self.slot[:, :, None], self.slot[:, None, :]])


def alike(unit: Integers, known: Integers) -> list[Integers]:
    """The values `known` [k] of the units `unit` [m] as tables [units, values] of units with equally many values, which
    are processed together."""
    order = known[np.argsort(unit[known], kind="stable")]
    _, first, count = np.unique(unit[order], return_index=True, return_counts=True)
    tables = []
    for size in np.unique(count).tolist():
        starts = first[count == size]
        for some in np.array_split(starts, -(-len(starts) * size**2 // TOGETHER)):
            tables.append(order[some[:, None] + np.arange(size)])
    return tables


def _connected(values: list[Integers], number: int) -> Integers:
    """The number of the connected set of each trajectory, of which those with a value in common are connected."""
    rows, columns, first = [], [], number
    for value in values:
        rows.append(np.arange(number))
        columns.append(first + value)
        first += int(value.max()) + 1
    here, there = np.concatenate(rows), np.concatenate(columns)
    graph = coo_matrix((np.ones(len(here)), (here, there)), shape=(first, first))
    return np.asarray(np.unique(connected_components(graph, directed=False)[1][:number], return_inverse=True)[1])
