"""Constants of a finished fit at which the sum of squares jumps, or has a kink."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model
from gbspec.training.engines import residual_vector
from gbspec.training.optimise import Passing, at_kinks
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.constants import EXACT
from gbspec.training.runs.summary import MemberResult, whole_solutions
from gbspec.training.starts import at_jumps

ROW = 1e-6
"""A time is that of a row to this part of the times."""

_OF_EVENTS = (
    "a value measured then is that before an event or a dose on one side, and that after it on the other. Every row "
    "that such a time may pass ends a piece with a minimum of its own, so that a better one may exist, `{name}` has no "
    "interval, and those of the others take it for known. `gbspec profile` tries other values; so does `--effort high`"
)
_OF_SWITCHES = (
    "a right side switches within a step of the solver, a part of which passes to the other side just beside this "
    "value, as where a solution slides along a switch. So `{name}` has no interval, and those of the others take it "
    "for known. `gbspec profile` tries other values; a smooth switch, such as `tanh` of the difference over a width, "
    "has slopes"
)
_OF_KINKS = (
    "where the sum of squares has a kink, as where the time of an event or a dose passes a row, another event or a "
    "change of an input: it rises to both sides, with different slopes. Standard deviations and intervals have the "
    "slope of one side alone"
)


def without_jumping(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """Takes their standard deviations from such constants; a sentence for each. `stages` are those that led to
    `theta`."""
    if parameters.n_weights or context.model.diffusions or context.model.marginal or not result.loss > EXACT:
        return []
    blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
    engine = context.engine(parameters, blend, step_fraction(stages))
    names = [context.model.learnables[parameters.shared[i]].name for i in at_jumps(engine, theta)]
    result.sd |= dict.fromkeys(names, math.nan)
    result.at_most = dict.fromkeys(names, 0.0) | result.at_most
    reason = _OF_EVENTS if context.model.events or context.model.doses else _OF_SWITCHES
    return [
        f"`{name}` ended at {result.constants[name]:.6g}, where the sum of squares jumps: {reason.format(name=name)}"
        for name in names
    ]


def said_of_kinks(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """A sentence for each constant that has come to rest at a kink of the sum of squares. `stages` are those that led
    to `theta`."""
    model, entries = context.model, Passing.of(context.model, parameters).entries
    if not entries or parameters.n_weights or model.diffusions or model.marginal or not result.loss > EXACT:
        return []
    blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
    engine = context.engine(parameters, blend, step_fraction(stages))
    found = at_kinks(lambda at: mean_loss(residual_vector(engine, at)), theta, entries)
    return [_said_of_kink(context, parameters, theta, entry) for entry in found]


def _said_of_kink(context: Context, parameters: Parameters, theta: Array, entry: int) -> str:
    """The sentence for the constant of an entry, which may be that of one trajectory."""
    own, trajectory = entry >= parameters.n_shared, 0
    if own:
        trajectory, place = divmod(entry - parameters.n_shared, parameters.n_local)
    i = parameters.own[place] if own else parameters.shared[entry - parameters.n_weights]
    values = parameters.constants(torch.from_numpy(theta)).numpy()[trajectory]
    learnable, value = context.model.learnables[i], float(values[len(context.model.constants) + i])
    items = context.trajectories.items
    times = items[trajectory].times if own else np.concatenate([item.times for item in items])
    where = f" in trajectory `{context.packed().labels[trajectory]}`" if own else ""
    more = "" if own else ". `gbspec profile` gives intervals that have both"
    row = _row(context.model, learnable, value, times)
    return f"`{learnable.name}` ended at {value:.6g}{where}{row}, {_OF_KINKS}{more}"


def _row(model: Model, learnable: Learnable, value: float, times: Array) -> str:
    """Which of the rows at `times` that is, if an event happens at the constant itself and a row is there."""
    timed = any(event.timing is not None and event.timing.at == learnable.symbol for event in model.events)
    place = int(np.argmin(np.abs(times - value)))
    beside = timed and abs(times[place] - value) <= ROW * max(abs(value), float(np.ptp(times)))
    return f", the row {model.time.name} = {times[place]:.6g}" if beside else ""
