"""Pieces of trajectories that do not depend on each other, stepped as one batch whose live prefix shrinks.

Where forcing replaces every state at a key row, what comes after does not depend on what came before: there the
trajectory is cut, and the next piece starts from the values put in. Under teacher forcing with all states measured each
interval is a piece, and the batch is as deep as the longest interval; without such rows every trajectory is one piece.
Pieces are sorted by falling number of sub-steps, so that those that still run are the first ones of the batch, and no
work is done for those that have ended. Values and gradients are those of the trajectories stepped whole.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines.torch.doses import SubStep, arrivals
from gbspec.training.problem.packing import Integers, Packed

if TYPE_CHECKING:
    from gbspec.training.problem.problem import Problem


@dataclass(frozen=True)
class Pieces:
    """P pieces: trajectory `owner`, its sub-step `first` with which the piece begins, number of sub-steps `length`, and
    the key row `start` from whose forced values it starts, -1 where the trajectory itself starts (each [P]).

    Every key row [R] is reached by the piece `row_piece` after `row_step` of its sub-steps.
    """

    owner: Integers
    first: Integers
    length: Integers
    start: Integers
    row_piece: Integers
    row_step: Integers

    @property
    def depth(self) -> int:
        """Number of sub-steps of the longest piece."""
        return int(self.length.max(initial=0))

    def live(self, step: int) -> int:
        """How many pieces take more than `step` sub-steps: the live prefix."""
        return int(np.searchsorted(-self.length, -step, side="left"))


def cut(packed: Packed, weight: Array) -> Pieces:
    """The pieces under forcing by `weight` [R, n_states]; sub-steps after a trajectory's last row are left out."""
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
    piece = np.cumsum(begins) - 1
    row_piece, row_step = np.empty_like(packed.row_step), np.empty_like(packed.row_step)
    row_piece[order], row_step[order] = rank[piece], step - first[piece]
    start = np.where(before < 0, -1, order[before])
    return Pieces(owner[begin][sorting], first[sorting], length[sorting], start[sorting], row_piece, row_step)


class Schedule:
    """The sub-steps of a problem's pieces as tensors of a type: made once, stepped through many times.

    `steps[s]` is sub-step `s` of the live prefix (its doses left out, which may depend on what is learned);
    `resets[s]`: what is put in on arrival there, `x <- given + kept * x`, None where nothing is (starts of pieces
    apart). `condition` [P, n_conditions]; `start` [P, n_states] are forced starts of pieces, `fresh` [P, 1] says which
    start where their trajectory does; `row` [R] is the place of each key row's state on arrival among those of all
    sub-steps, joined.
    """

    def __init__(self, problem: Problem, dtype: torch.dtype = torch.float64) -> None:
        packed, forcing = problem.packed, problem.forcing
        pieces = cut(packed, forcing.weight)
        self.pieces = pieces
        device = problem.device

        def tensor(table: Any) -> Tensor:
            made = torch.from_numpy(table).to(device)
            return made.to(dtype) if made.is_floating_point() else made

        self.fresh = tensor(pieces.start[:, None] < 0)
        value = forcing.value[pieces.start] if packed.rows else np.zeros((0, forcing.value.shape[1]))
        self.start = tensor(value)
        self.owner = tensor(pieces.owner)
        self.condition = tensor(packed.condition[pieces.owner])
        counts = [len(pieces.owner), *(pieces.live(s) for s in range(pieces.depth))]
        self.steps: list[SubStep] = []
        for s, live in enumerate(counts[1:]):
            at = pieces.first[:live] + s, pieces.owner[:live]
            t, h, inputs = (tensor(table[at]) for table in (packed.t, packed.h, packed.inputs))
            grid = problem.module._grid(problem.ops, t, h)
            self.steps.append(SubStep(t, h, self.condition[:live], inputs.unbind(1), None, grid))
        self.resets = [
            None if reset is None else (tensor(reset[0]), tensor(reset[1])) for reset in self._resets(problem, counts)
        ]
        offsets = np.concatenate([[0], np.cumsum(counts)])
        self.row = tensor(offsets[pieces.row_step] + pieces.row_piece)

    def _resets(self, problem: Problem, counts: list[int]) -> list[tuple[Array, Array] | None]:
        """What is given and what is kept, by sub-step; rows at which a piece ends are left out, as nothing follows."""
        pieces, forcing = self.pieces, problem.forcing
        out: list[tuple[Array, Array] | None] = [None] * len(counts)
        inside = pieces.row_step < pieces.length[pieces.row_piece] if len(pieces.owner) else np.zeros(0, dtype=bool)
        rows = np.flatnonzero(inside & forcing.weight.any(axis=1))
        rows = rows[np.argsort(pieces.row_step[rows], kind="stable")]
        steps, begins = np.unique(pieces.row_step[rows], return_index=True)
        for step, own in zip(steps.tolist(), np.split(rows, begins[1:]), strict=False):
            value, weight = np.zeros((2, counts[step], forcing.value.shape[1]))
            value[pieces.row_piece[own]], weight[pieces.row_piece[own]] = forcing.value[own], forcing.weight[own]
            out[step] = weight * value, 1.0 - weight
        return out

    def with_doses(self, problem: Problem, constants: Tensor) -> list[SubStep]:
        """The sub-steps with the doses that arrive in them at the constants [N, n_constants]."""
        events = arrivals(problem, constants)
        if not len(events):
            return self.steps
        first, owner = self.pieces.first, self.pieces.owner
        lives = [len(step.t) for step in self.steps]
        return [
            replace(step, events=events[:, first[:live] + s, owner[:live]])
            for s, (step, live) in enumerate(zip(self.steps, lives, strict=True))
        ]
