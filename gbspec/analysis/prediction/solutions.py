"""Predictions from initial states: where each trajectory starts, and the adaptive solution from there.

Nothing here uses the training's step: solutions come from the evaluator's CVODES.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from gbspec.arrays import Array
from gbspec.data import evaluate, fingerprint
from gbspec.diagnostics import ComputationError

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.data import Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import DataRecord

Origin = Literal["learned", "known", "estimated", "failed"]
"""Where an initial state comes from: learned in training; known (expressed by the model, or measured at the first row);
estimated from the trajectory's own data; or none could be found."""

RTOL = 1e-8


@dataclass(frozen=True)
class Start:
    """Where a trajectory starts: state [n], the constants [K] that hold for it, and where that comes from."""

    state: Array
    constants: Array
    origin: Origin
    failure: str = ""


@dataclass(frozen=True)
class Prediction:
    """The solution of one trajectory at its rows: states [R, n] and channels [R, C]; NaN from where it failed.

    `failure` says why there is none; empty where there is one.
    """

    label: str
    start: Start
    times: Array
    states: Array
    channels: Array
    failure: str = ""


def needed(model: Model, item: Trajectory) -> tuple[int, ...]:
    """The states whose start neither the model expresses nor the first row measures."""
    measured = {
        channel.state
        for j, channel in enumerate(model.channels)
        if channel.state is not None
        and len(item.times)
        and item.times[0] == item.start
        and np.isfinite(item.values[0, j])
    }
    return tuple(
        i
        for i, state in enumerate(model.states)
        if state.initial.kind == "learned" or (state.initial.kind == "measured" and i not in measured)
    )


def measured_start(model: Model, item: Trajectory, otherwise: Array) -> Array:
    """The state [n] with what the first row measures put into `otherwise` [n]."""
    state = otherwise.copy()
    if len(item.times) and item.times[0] == item.start:
        for j, channel in enumerate(model.channels):
            if channel.state is not None and np.isfinite(item.values[0, j]):
                state[channel.state] = item.values[0, j]
    return state


def learned_positions(member: GeneratedModule, trajectories: Trajectories, data: DataRecord | None) -> list[int | None]:
    """Where each trajectory stands in the training data of a member, by content; None where it is new.

    The member's remarks hold the fingerprints of its trajectories; failing that, a table with the same SHA-256 as the
    one trained on (`data` of `fit.json`) is the same in order.
    """
    known = member.info.get("fingerprints")
    count = len(member.weights.get("initial", ()))
    if known:
        table = {content: position for position, content in enumerate(known)}
        return [table.get(fingerprint(item)) for item in trajectories.items]
    recorded = "" if data is None else data.sha256
    same = bool(recorded) and trajectories.sha256 == recorded and count == len(trajectories)
    return [i if same else None for i in range(len(trajectories))]


def learned_start(evaluator: Evaluator, position: int, item: Trajectory) -> Start:
    """The start that training found for the trajectory at this position of its data."""
    member = evaluator.instance
    constants = own_constants(evaluator, position)
    state = np.array(member.weights["initial"][position], dtype=float)
    return Start(evaluator.initial(state, item.condition, constants), constants, "learned")


def own_constants(evaluator: Evaluator, position: int) -> Array:
    """The constants [K] of one training trajectory: the shared ones, and its own where each has one."""
    member = evaluator.instance
    constants = np.array(evaluator.constants, dtype=float)
    for name in member.per_trajectory:
        own = member.weights.get(f"per_trajectory.{name}")
        if own is not None:
            constants[member.constants.index(name)] = own[position]
    return constants


def predict(
    evaluator: Evaluator, model: Model, item: Trajectory, start: Start, rtol: float = RTOL, scales: Array | None = None
) -> Prediction:
    """The solution at the trajectory's rows from its start; a failure is reported, not raised."""
    rows = len(item.times)
    empty = np.full((rows, len(model.states)), np.nan), np.full((rows, len(model.channels)), np.nan)
    if start.origin == "failed" or rows == 0:
        return Prediction(item.label, start, item.times, *empty, start.failure)
    try:
        states = evaluator.integrate(
            start.state,
            item.times,
            item.condition,
            item.inputs,
            item.start,
            doses=item.doses,
            constants=start.constants,
            rtol=rtol,
            atol=rtol,
            scales=scales,
        )
    except ComputationError as error:
        return Prediction(item.label, start, item.times, *empty, f"{error.what} ({error.where})")
    channels = evaluator.observe_many(
        item.times, states, item.condition, input_values(model, item, item.times), start.constants
    )
    if not np.isfinite(channels).all():
        return Prediction(item.label, start, item.times, states, channels, "a channel is not finite")
    return Prediction(item.label, start, item.times, states, channels)


def input_values(model: Model, item: Trajectory, times: Array) -> Array:
    """The inputs [T, m] of a trajectory at `times`."""
    columns = [
        evaluate(signal, one.interpolation, times) for signal, one in zip(item.inputs, model.inputs, strict=True)
    ]
    return np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))


def mean_prediction(predictions: Sequence[Prediction]) -> Prediction:
    """The mean of several members' predictions of one trajectory; a failure of any is one of the mean."""
    first = predictions[0]
    if len(predictions) == 1:
        return first
    failures = [f"member {k}: {one.failure}" for k, one in enumerate(predictions) if one.failure]
    start = replace(
        first.start,
        state=np.mean([one.start.state for one in predictions], axis=0),
        constants=np.mean([one.start.constants for one in predictions], axis=0),
    )
    return Prediction(
        first.label,
        start,
        first.times,
        np.mean([one.states for one in predictions], axis=0),
        np.mean([one.channels for one in predictions], axis=0),
        "; ".join(failures),
    )
