"""Jacobians and the parts from which they are assembled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.training.problem import Integers


@dataclass(frozen=True)
class Jacobian:
    """Derivatives of m measured values.

    `shared` [m, n_shared]: columns of weights and shared constants; `local` [m, n_local]: columns of the local block of
    the trajectory `owner` [m] of the value (entries in other local blocks are zero).
    """

    shared: Tensor
    local: Tensor
    owner: Tensor


@dataclass(frozen=True)
class Linearised(Jacobian):
    """Residuals [m] and their Jacobian at one vector."""

    residuals: Tensor


@dataclass(frozen=True)
class Batch:
    """Sequences of sub-steps, longest first: their trajectory, first sub-step and number of sub-steps (each [B])."""

    owner: Integers
    first: Integers
    length: Integers

    @property
    def depth(self) -> int:
        """The largest number of sub-steps of a row."""
        return int(self.length.max(initial=0))

    def live(self, step: int) -> int:
        """The number of rows with more than `step` sub-steps: the length of the live prefix."""
        return int(np.searchsorted(-self.length, -step, side="left"))

    @property
    def groups(self) -> list[tuple[int, int, int]]:
        """(length, begin, end) of each group of successive rows of equal positive length."""
        out = []
        for length in sorted({int(n) for n in self.length if n > 0}, reverse=True):
            begin = int(np.searchsorted(-self.length, -length, side="left"))
            end = int(np.searchsorted(-self.length, -length, side="right"))
            out.append((length, begin, end))
        return out


@dataclass(frozen=True)
class Observed:
    """Derivatives of the m measured values with respect to the state [m, n], and direct ones in the shared and local
    columns (or None).

    `row` [m] is the key row of each value; `bounds` [R + 1] the index at which each row's values begin.
    """

    row: Tensor
    bounds: Integers
    state: Tensor
    shared: Tensor | None
    local: Tensor | None

    def of_rows(self, rows: slice) -> slice:
        """The values of some key rows."""
        return slice(int(self.bounds[rows.start]), int(self.bounds[rows.stop]))

    def _apply(self, rows: slice, sensitivity: Tensor, direct: Tensor | None) -> Tensor:
        part = self.of_rows(rows)
        which = self.row[part] - rows.start
        out = torch.bmm(self.state[part][:, None, :], sensitivity[which])[:, 0]
        return out if direct is None else out + direct[part]

    def apply_shared(self, rows: slice, sensitivity: Tensor) -> Tensor:
        """Rows of the Jacobian's shared columns, from the states' sensitivities before `rows`."""
        return self._apply(rows, sensitivity, self.shared)

    def apply_local(self, rows: slice, sensitivity: Tensor) -> Tensor:
        """Rows of the Jacobian's local columns."""
        return self._apply(rows, sensitivity, self.local)
