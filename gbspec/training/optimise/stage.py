"""What a stage of an estimation is: it takes the trainable vector somewhere better, one resumable step at a time.

A stage's whole state between two steps is a dictionary of arrays, so that a checkpoint is that dictionary and a resumed
stage goes on exactly as it would have gone on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, explain_failure

State = dict[str, Array]


@dataclass(frozen=True)
class Outcome:
    """The state after a step, the loss there (mean of half squared residuals), and whether the stage is at its end.

    `note` is a remark for the user that belongs to the fit.
    """

    state: State
    loss: float
    done: bool
    note: str = ""


class Stage(Protocol):
    """One stage. `name` is shown and kept in the history; `total` bounds the number of steps."""

    name: str
    total: int

    def begin(self, theta: Array) -> State:
        """The state before the first step; it has the vector under `theta`."""

    def step(self, state: State, iteration: int) -> Outcome:
        """One step from a state (which it does not change). Raises ComputationError where there is no way on."""


def require_finite(engine: Engine, theta: Array, residuals: Array, stage: str) -> None:
    """Raises ComputationError that says where a solution blew up, if it did."""
    if not np.isfinite(residuals).all():
        raise explain_failure(engine.problem, engine.parameters, theta, stage)


def scalar(state: Mapping[str, Array], name: str) -> float:
    """A number kept in a state."""
    return float(state[name])
