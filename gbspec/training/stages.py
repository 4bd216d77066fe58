"""The stages of an estimation: each takes the trainable vector somewhere better, one resumable step at a time.

A stage's whole state between two steps is a dictionary of arrays, so that a checkpoint is that dictionary and a resumed
stage goes on exactly as it would have gone on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from gbspec.data.trajectories import Array
from gbspec.diagnostics import ComputationError
from gbspec.training.bounds import Bijections
from gbspec.training.context import Context
from gbspec.training.initial_states import refit_starts
from gbspec.training.parameters import Parameters
from gbspec.training.problem import Forcing, Problem
from gbspec.training.unroll import explain_failure, solve
from gbspec.training.warm_start import eliminate, network_scales, regress_slopes

State = dict[str, Array]


@dataclass(frozen=True)
class Outcome:
    """The state after a step, the loss there (mean of half squared residuals), and whether the stage is at its end."""

    state: State
    loss: float
    done: bool


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


def initial_parameters(context: Context) -> tuple[Parameters, Array]:
    """The layout and the vector before training: fresh weights, networks scaled by the data, constants as declared.

    With a warm start the constants are those that eliminating the unknown functions gives, where that helps.
    """
    model = context.model
    learnables = Bijections.of(model.learnables)
    start = learnables.from_natural(np.array([k.start for k in model.learnables], dtype=np.float64))
    fixed: dict[str, Array] = {
        n: v for n, v in context.module.weights.items() if n.partition(".")[2].rpartition("_")[2] in ("center", "scale")
    }
    constants = start
    if len(context.points):
        eliminated = eliminate(model, context.module, context.points, start)
        fixed = network_scales(model, eliminated)
        if context.options.warm_start and np.isfinite(eliminated.constants).all():
            constants = eliminated.constants
    parameters = context.parameters(fixed)
    natural = learnables.to_natural(torch.from_numpy(constants)).numpy() if len(constants) else constants
    return parameters, parameters.vector(context.module.weights, natural)


class WarmStart:
    """Gradient matching: one step."""

    name = "warm start"
    total = 1

    def __init__(self, context: Context, parameters: Parameters) -> None:
        self.context, self.parameters = context, parameters

    def begin(self, theta: Array) -> State:
        """Nothing but the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Slope regression; kept if it does not leave the solution worse than not finite."""
        context = self.context
        theta = regress_slopes(self.parameters, context.module, context.points, state["theta"], context.seed)
        loss = mean_loss(solve(context.problem(), self.parameters, theta))
        return Outcome({"theta": theta}, loss, True)


class InitialStates:
    """The refit of initial states, trajectory by trajectory: one step."""

    name = "initial states"
    total = 1

    def __init__(self, problem: Problem, parameters: Parameters, seed: int) -> None:
        self.problem, self.parameters, self.seed = problem, parameters, seed

    def begin(self, theta: Array) -> State:
        """Nothing but the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Refits all starts at once."""
        theta = refit_starts(self.problem, self.parameters, state["theta"], self.seed)
        return Outcome({"theta": theta}, mean_loss(solve(self.problem, self.parameters, theta)), True)


def require_finite(problem: Problem, parameters: Parameters, theta: Array, residuals: Array, stage: str) -> None:
    """Raises ComputationError that says where a solution blew up, if it did."""
    if not np.isfinite(residuals).all():
        error: ComputationError = explain_failure(problem, parameters, theta, stage)
        raise error


def scalar(state: Mapping[str, Array], name: str) -> float:
    """A number kept in a state."""
    return float(state[name])
