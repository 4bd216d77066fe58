"""Bred initial states: initial states on the slow manifold, to which the dynamics themselves have brought them.

Many initial states differ only along directions that decay before the first measurement, so that the data cannot
distinguish them. In a solution that has run for some time these components have decayed. Each trajectory is therefore
begun `AGE` mean intervals earlier, with the inputs that it has at its start. That earlier state is fitted with all
shared parameters fixed, and the solution from there gives the initial state ("breeding": Gear and others 2005;
Balmaseda and others 2009).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.data import Limits, Trajectories, Trajectory
from gbspec.training.engines import predicted, residual_vector
from gbspec.training.optimise import Outcome, State
from gbspec.training.problem import Parameters, Problem, mean_loss, teacher_forcing
from gbspec.training.recipe.context import Context
from gbspec.training.stages import StageName
from gbspec.training.starts import refit_starts

AGE = 9.0
"""How much earlier the fitted state is, in units of the trajectory's mean interval between rows."""


def expressed(context: Context) -> list[str]:
    """The states whose initial value is an expression of the model; the time before it is then undefined."""
    return [state.name for state in context.model.states if state.initial.known]


def bred_starts(context: Context, parameters: Parameters, theta: Array, blend: float) -> Array:
    """The vector with every learned initial state bred; measured ones, and results that are not finite, are not
    changed."""
    early = _early_problem(context, blend)
    earlier = context.choice.engine(early, replace(parameters, start_free=np.ones_like(parameters.start_free)))
    fitted = refit_starts(earlier, theta, context.seed)
    out = predicted(earlier, fitted)
    with torch.no_grad():
        now = parameters.starts(torch.from_numpy(theta)).numpy()
    first = np.flatnonzero(early.packed.row_index == 0)
    bred = now.copy()
    bred[early.packed.row_trajectory[first]] = out.before[first]
    usable = np.isfinite(bred).all(axis=1, keepdims=True) & (context.start_free > 0)
    return parameters.with_starts(theta, np.where(usable, bred, now))


def _early_problem(context: Context, blend: float) -> Problem:
    """The problem of trajectories that begin earlier, each with a row at its present initial time."""
    items = tuple(_begun_earlier(item) for item in context.trajectories.items)
    data: Trajectories = replace(context.trajectories, items=items)
    packed = context.pack(data)
    return context.posed(packed, teacher_forcing(context.model, packed, blend))


def _begun_earlier(item: Trajectory) -> Trajectory:
    span, rows = item.end - item.start, max(len(item.times) - 1, 1)
    earlier = replace(item, start=item.start - AGE * span / rows)
    if len(item.times) and item.times[0] == item.start:
        return earlier

    def below(rows: Array, value: float) -> Array:
        return np.concatenate([np.full((1, *rows.shape[1:]), value), rows])

    return replace(
        earlier,
        times=below(item.times, item.start),
        values=below(item.values, np.nan),
        counts=below(item.counts, 0.0),
        sd=below(item.sd, np.nan),
        scatter=None if item.scatter is None else below(item.scatter, 0.0),
        limits=None if item.limits is None else Limits(below(item.limits.value, np.nan), _unlimited(item.limits.side)),
    )


def _unlimited(side: NDArray[np.int8]) -> NDArray[np.int8]:
    """Sides with a first row that has no limit."""
    return np.concatenate([np.zeros((1, side.shape[1]), dtype=np.int8), side])


class Breeding:
    """The stage that breeds all learned initial states, in one step."""

    name = StageName.BREEDING.value
    total = 1

    def __init__(self, context: Context, parameters: Parameters, blend: float) -> None:
        self.context, self.parameters, self.blend = context, parameters, blend

    def begin(self, theta: Array) -> State:
        """The initial state: only the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Breeds; if an initial value is an expression of the model, changes nothing and adds a note."""
        engine, theta, note = self.context.engine(self.parameters, self.blend), state["theta"], ""
        known = expressed(self.context)
        if known:
            names = ", ".join(f"`{name}`" for name in known)
            note = f"initial states were not bred, since the model gives the initial value of {names}"
        else:
            theta = bred_starts(self.context, self.parameters, theta, self.blend)
        return Outcome({"theta": theta}, mean_loss(residual_vector(engine, theta)), True, note)
