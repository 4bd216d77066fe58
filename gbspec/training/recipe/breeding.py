"""Bred initial states: starts that lie on the slow manifold, because the dynamics themselves brought them there.

Many starts differ only along directions that die out before the first measurement, so the data cannot choose among
them. What has run for a while has lost such parts. Each trajectory is therefore begun `AGE` mean intervals earlier,
with inputs as they are at its start; that earlier state is fitted, everything shared being frozen, and the solution
from there gives the start ("breeding": Gear and others 2005; Balmaseda and others 2009).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.data import Trajectories, Trajectory
from gbspec.training.engines import predicted, residual_vector
from gbspec.training.optimise import Outcome, State
from gbspec.training.problem import Parameters, Problem, mean_loss, pack, scaling_of, teacher_forcing
from gbspec.training.recipe.context import Context
from gbspec.training.stages import StageName
from gbspec.training.starts import refit_starts

AGE = 9.0
"""How much earlier the fitted state lies, in the trajectory's mean interval between rows."""


def expressed(context: Context) -> list[str]:
    """The states whose start the model expresses: with one of them, nothing is known of the time before."""
    return [state.name for state in context.model.states if state.initial.kind == "expression"]


def bred_starts(context: Context, parameters: Parameters, theta: Array, blend: float) -> Array:
    """The vector with every learned start bred; measured ones, and those without a finite number, stay as they were."""
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
    """The problem of trajectories that begin earlier, each with a row at its present start."""
    items = tuple(_begun_earlier(item) for item in context.trajectories.items)
    data: Trajectories = replace(context.trajectories, items=items)
    packed = pack(data, context.model, context.max_step, method=context.method)
    scaling = scaling_of(context.model, packed, context.trajectories)
    return Problem(context.model, context.module, packed, teacher_forcing(context.model, packed, blend), scaling)


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
    )


class Breeding:
    """Breeds all learned starts: one step."""

    name = StageName.BREEDING.value
    total = 1

    def __init__(self, context: Context, parameters: Parameters, blend: float) -> None:
        self.context, self.parameters, self.blend = context, parameters, blend

    def begin(self, theta: Array) -> State:
        """Nothing but the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Breeds; with expressed starts it leaves everything as it is, and says so."""
        engine, theta, note = self.context.engine(self.parameters, self.blend), state["theta"], ""
        known = expressed(self.context)
        if known:
            names = ", ".join(f"`{name}`" for name in known)
            note = f"initial states were not bred, since the model gives the initial value of {names}"
        else:
            theta = bred_starts(self.context, self.parameters, theta, self.blend)
        return Outcome({"theta": theta}, mean_loss(residual_vector(engine, theta)), True, note)
