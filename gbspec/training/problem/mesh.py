"""Meshes: the steps of a path that were chosen by an error estimate, and the frozen matrices of its steps.

A packing's sub-steps are cells that no step crosses. Where steps are adaptive, each cell is divided into the steps that
were accepted at one vector; where the method needs them, each step has its matrix I - gamma M, factored. A path with
both is fixed: solutions on it are a smooth function of the vector, and their derivatives are those of the steps taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.training.problem.arrivals import Integers

Pivots = NDArray[np.int32]

MOST_STEPS = 20_000
"""A trajectory that needs more accepted steps than this between two full resets counts as one without a solution."""
FLOOR = 0.1
"""Errors of a state count relative to its size, but at least this share of its scale."""


@dataclass(frozen=True)
class Control:
    """Control of the steps: the relative tolerance of the error estimate of each step, and the scale of each state
    [n_states]; an error e of a state x counts as e / (rtol * (|x| + FLOOR * scale))."""

    rtol: float
    scale: Array

    @property
    def floor(self) -> Array:
        """What is added to the size of a state."""
        return np.asarray(FLOOR * self.scale, dtype=np.float64)


@dataclass(frozen=True)
class Factors:
    """The factored matrices I - gamma M of each sub-step: `lu` [T, N, n, n] and `pivots` [T, N, n], as LAPACK's.

    In models with events, which cut sub-steps, each part has a matrix for its own length: `lu` then are the Jacobians W
    of the right-hand side, not factored, and `pivots` is [T, N, 0].
    """

    lu: Array
    pivots: Pivots

    @property
    def whole(self) -> bool:
        """Whether the matrices are those of whole sub-steps, factored."""
        return bool(self.pivots.shape[2] == self.lu.shape[2])


@dataclass(frozen=True)
class Steps:
    """The steps in the cells of a path [A], in any order between cells and in the order of time within one.

    `owner`, `cell`: trajectory and sub-step of the path; `begin`, `length`: after the cell's start (NaN: there is no
    solution); `lu` [A, n, n] and `pivots` [A, n] as in `Factors`, with no entries
    [A, 0, 0] for methods without matrices.
    """

    owner: Integers
    cell: Integers
    begin: Array
    length: Array
    lu: Array
    pivots: Pivots

    @classmethod
    def joined(cls, parts: list[Steps]) -> Steps:
        """Several sets of steps as one."""
        names = ("owner", "cell", "begin", "length", "lu", "pivots")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
