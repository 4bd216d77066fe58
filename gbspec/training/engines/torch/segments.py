"""Segments of trajectories that do not depend on each other, stepped as one batch whose live prefix shrinks.

Where forcing replaces every state at a key row, the later solution does not depend on the earlier one: there the
trajectory is cut, and the next segment starts from the replacing values. Under teacher forcing with all states measured
each interval is a segment, and the batch is as deep as the longest interval; without such rows every trajectory is one
segment. Segments are sorted by decreasing number of sub-steps, so that those that are not yet complete come first in
the batch, and no work is done for complete ones. Values and gradients are the same as those of uncut trajectories.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines.linearised import Batch
from gbspec.training.engines.torch.sub_steps import SubStep, sub_step
from gbspec.training.problem import Integers, Packed, Path, Problem


@dataclass(frozen=True)
class Segments(Batch):
    """P segments, and the key row `start` [P] from whose forced values each starts, -1 for the first segment of a
    trajectory.

    Every key row [R] is reached by the segment `row_segment` after `row_step` of its sub-steps.
    """

    start: Integers
    row_segment: Integers
    row_step: Integers


def cut(packed: Packed, weight: Array) -> Segments:
    """The segments under forcing by `weight` [R, n_states]; sub-steps after a trajectory's last row are omitted."""
    forced: NDArray[np.bool_] = np.all(weight == 1.0, axis=1)
    order = np.lexsort((packed.row_index, packed.row_trajectory))
    owner, step = packed.row_trajectory[order], packed.row_step[order]
    fresh = np.ones(packed.rows, dtype=bool)
    fresh[1:] = owner[1:] != owner[:-1]
    begins = fresh.copy()
    begins[1:] |= forced[order[:-1]]
    begin = np.flatnonzero(begins)
    end = np.append(begin[1:], packed.rows)[: len(begin)] - 1
    before = np.where(fresh[begin], -1, begin - 1)
    first = np.where(before < 0, 0, step[before])
    length = step[end] - first
    sorting = np.argsort(-length, kind="stable")
    rank = np.empty_like(sorting)
    rank[sorting] = np.arange(len(sorting))
    segment = np.cumsum(begins) - 1
    row_segment, row_step = np.empty_like(packed.row_step), np.empty_like(packed.row_step)
    row_segment[order], row_step[order] = rank[segment], step - first[segment]
    start = np.where(before < 0, -1, order[before])
    return Segments(owner[begin][sorting], first[sorting], length[sorting], start[sorting], row_segment, row_step)


class Schedule:
    """The sub-steps of a path as tensors of one type on one device.

    `fresh` [P, 1]: the first segments of trajectories; `start` [P, n_states]: the initial states of the others; `owner`
    [P], `condition` [P, n_conditions]; `steps`: one per depth; `resets`: before each step, the added values and the
    factors on the states, or None; `row` [R]: the index of each key row among the concatenated states of all depths.
    """

    def __init__(self, problem: Problem, path: Path, dtype: torch.dtype, device: str) -> None:
        packed, forcing = path.packed, problem.forcing
        # With delays, later steps look at the solution before.
        whole = np.zeros_like(forcing.weight) if problem.model.delays else forcing.weight
        segments = cut(packed, whole)
        self.segments = segments

        def tensor(table: NDArray[np.generic]) -> Tensor:
            made = torch.from_numpy(table).to(device)
            return made.to(dtype) if made.is_floating_point() else made

        self.fresh = tensor(segments.start[:, None] < 0)
        value = forcing.value[segments.start] if packed.rows else np.zeros((0, forcing.value.shape[1]))
        self.start = tensor(value)
        self.owner = tensor(segments.owner)
        self.condition = tensor(packed.condition[segments.owner])
        counts = [len(segments.owner), *(segments.live(s) for s in range(segments.depth))]
        self.steps: list[SubStep] = [
            sub_step(problem, path, segments.first[:live] + s, segments.owner[:live], self.start)
            for s, live in enumerate(counts[1:])
        ]
        self.resets = [
            None if reset is None else (tensor(reset[0]), tensor(reset[1])) for reset in self._resets(problem, counts)
        ]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        self.row = tensor(offsets[segments.row_step] + segments.row_segment)

    def _resets(self, problem: Problem, counts: list[int]) -> list[tuple[Array, Array] | None]:
        """Added values and factors on the states by sub-step, except at rows where a segment ends."""
        segments, forcing = self.segments, problem.forcing
        out: list[tuple[Array, Array] | None] = [None] * len(counts)
        inside = np.zeros(0, dtype=bool)
        if len(segments.owner):
            inside = segments.row_step < segments.length[segments.row_segment]
        rows = np.flatnonzero(inside & forcing.weight.any(axis=1))
        rows = rows[np.argsort(segments.row_step[rows], kind="stable")]
        steps, begins = np.unique(segments.row_step[rows], return_index=True)
        for step, own in zip(steps.tolist(), np.split(rows, begins[1:]), strict=False):
            value, weight = np.zeros((2, counts[step], forcing.value.shape[1]))
            value[segments.row_segment[own]] = forcing.value[own]
            weight[segments.row_segment[own]] = forcing.weight[own]
            out[step] = weight * value, 1.0 - weight
        return out
