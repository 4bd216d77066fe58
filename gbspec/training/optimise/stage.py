"""The interface of a stage of the estimation, which improves the trainable vector in resumable steps.

The complete state of a stage between two steps is a dictionary of arrays, which is also its checkpoint: a resumed stage
continues exactly as if it had not been interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.runs import SearchRecord
from gbspec.training.engines import Engine, explain_failure

State = dict[str, Array]


@dataclass(frozen=True)
class Outcome:
    """The state after a step, the loss there (mean of half squared residuals), and whether the stage has ended.

    `note` is a warning for the user that is kept with the fit; `remark` says in words how far the stage is, in the
    progress and afterwards in the summary; `search` is what a search has found so far. `unfinished`, of the last step
    of a likelihood, says why it is not at its maximum.
    """

    state: State
    loss: float
    done: bool
    note: str = ""
    remark: str = ""
    search: SearchRecord | None = None
    unfinished: ComputationError | None = None


class Stage(Protocol):
    """One stage. `name` is shown and kept in the history; `total` bounds the number of steps."""

    name: str
    total: int

    def begin(self, theta: Array) -> State:
        """The state before the first step; its entry `theta` is the vector."""

    def step(self, state: State, iteration: int) -> Outcome:
        """One step from a state (which it does not change). Raises ComputationError if it is impossible."""


def require_finite(engine: Engine, theta: Array, residuals: Array, stage: str) -> None:
    """Raises ComputationError, with trajectory and time, if a residual is not finite."""
    if not np.isfinite(residuals).all():
        raise explain_failure(engine.problem, engine.parameters, theta, stage)


def scalar(state: Mapping[str, Array], name: str) -> float:
    """A number stored in a state."""
    return float(state[name])
