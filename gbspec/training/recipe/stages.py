"""The stages of an estimation: each takes the trainable vector somewhere better, one resumable step at a time.

A stage's whole state between two steps is a dictionary of arrays, so that a checkpoint is that dictionary and a resumed
stage goes on exactly as it would have gone on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gbspec.data.trajectories import Array
from gbspec.training.engines.torch.unroll import explain_failure, solve
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Forcing, Problem
from gbspec.training.recipe.context import Context
from gbspec.training.starts.initial_states import refit_starts

State = dict[str, Array]

STARTS_TOO = "least squares, starts too"
"""The stage that fits measured first values as measurements, where all functions are known."""


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


def mean_loss(residuals: Array) -> float:
    """Mean of half squared residuals; infinite if one is not finite."""
    if not np.isfinite(residuals).all():
        return float("inf")
    return 0.5 * float(np.mean(residuals**2)) if len(residuals) else 0.0


def imputed_forcing(context: Context, problem: Problem) -> Forcing:
    """Every state replaced by its curve at every key row within the curve's span."""
    packed = problem.packed
    value, weight = np.zeros_like(problem.forcing.value), np.zeros_like(problem.forcing.weight)
    for row in range(packed.rows):
        curves = context.curves.items[int(packed.row_trajectory[row])]
        for state, curve in enumerate(curves):
            if curve is not None and curve.low <= packed.row_time[row] <= curve.high:
                value[row, state] = curve.value(packed.row_time[row : row + 1])[0]
                weight[row, state] = 1.0
    return Forcing(value, weight)


class InitialStates:
    """The refit of initial states, trajectory by trajectory: one step."""

    total = 1

    def __init__(self, name: str, problem: Problem, parameters: Parameters, seed: int) -> None:
        self.name, self.problem, self.parameters, self.seed = name, problem, parameters, seed

    def begin(self, theta: Array) -> State:
        """Nothing but the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Refits all starts at once."""
        theta = refit_starts(self.problem, self.parameters, state["theta"], self.seed)
        return Outcome({"theta": theta}, mean_loss(solve(self.problem, self.parameters, theta)), True)


class Choice:
    """Chooses between the fit of single intervals (teacher forcing) and that of whole solutions (autoregressive).

    Noise of measurement is treated rightly by the whole solution; where the system itself is disturbed, or the model
    lacks something, whole solutions may be beyond any fit, and the intervals tell more of the dynamics. So both fits
    are asked for both errors, initial states refitted for whole solutions, and the smaller product of the two wins:
    neither error's size matters, only by what factor each fit is better. One step.
    """

    name = "choice"
    total = 1

    def __init__(self, teacher: Problem, free: Problem, parameters: Parameters, earlier: Array, seed: int) -> None:
        self.teacher, self.free, self.parameters = teacher, free, parameters
        self.earlier, self.seed = earlier, seed

    def begin(self, theta: Array) -> State:
        """Nothing but the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Compares the two."""
        late = state["theta"]
        interval, whole = self._losses(late, late)
        note = WHOLE_WORSE if whole > interval else ""
        if whole <= interval:
            return Outcome(state, whole, True)
        refitted = refit_starts(self.free, self.parameters, self.earlier, self.seed)
        other_interval, other_whole = self._losses(self.earlier, refitted)
        if _product(other_interval, other_whole) < _product(interval, whole):
            return Outcome({"theta": refitted}, other_interval, True, f"{note}; the fit of intervals was kept")
        return Outcome(state, whole, True, note)

    def _losses(self, of_intervals: Array, of_whole: Array) -> tuple[float, float]:
        """Mean losses over intervals and of whole solutions."""
        return (
            mean_loss(solve(self.teacher, self.parameters, of_intervals)),
            mean_loss(solve(self.free, self.parameters, of_whole)),
        )


WHOLE_WORSE = (
    "solutions from the initial states follow the data less well than predictions from one row to the next: the system "
    "may be disturbed between rows, or the model may be incomplete"
)


def _product(interval: float, whole: float) -> float:
    """Of two losses; infinite if one of them is, whatever the other is."""
    return interval * whole if np.isfinite([interval, whole]).all() else float("inf")


def require_finite(problem: Problem, parameters: Parameters, theta: Array, residuals: Array, stage: str) -> None:
    """Raises ComputationError that says where a solution blew up, if it did."""
    if not np.isfinite(residuals).all():
        raise explain_failure(problem, parameters, theta, stage)


def scalar(state: Mapping[str, Array], name: str) -> float:
    """A number kept in a state."""
    return float(state[name])
