"""Predictions from initial states: the start of each trajectory, and the adaptive solution from it.

Nothing here uses the step of the training: solutions come from the evaluator's CVODES.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import continued, evaluate, fingerprint, measured_rows
from gbspec.diagnostics import ComputationError
from gbspec.ir import logarithmic

if TYPE_CHECKING:
    from gbspec.analysis.systems import Extrapolation
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.data import Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import DataRecord

Origin = Literal["learned", "continued", "known", "estimated", "average", "smoothed", "failed"]
"""The origin of an initial state: learned in training, of this trajectory or of its first rows; known (given by the
model, or measured in the first row); estimated from the trajectory's own data, or where it has none the average of the
training; smoothed by all of them (disturbances); or failed, if none was found."""

ORIGINS: dict[Origin, str] = {
    "learned": "part of the training data: predicted from the learned initial state",
    "continued": "the first rows are of the training data: later ones are predicted from what was learned there",
    "known": "the initial state is given by the first row and the model",
    "estimated": "what is unknown was estimated from the first rows, with all shared parameters held fixed",
    "average": "nothing was measured in the first rows: what is unknown is the mean of the training, or of a group",
    "smoothed": "shown by all measurements; `--window N` predicts the rows after the first N from these",
    "failed": "no initial state was found from which it can be solved",
}
"""What is said of trajectories by the origin of their starts."""
BY_MODEL = "the initial state is given by the model"
"""The same of known starts for which no row is used."""
ALIKE = "the same rows as one of the training data that has another label: predicted from what was learned there"
"""The same of those whose starts were learned of a trajectory with another label."""

RTOL = 1e-8
IN_LOGARITHMS = 1e-6
"""The absolute tolerance, as a part of the relative one, where logarithms are measured: of values that fall by
decades."""


@dataclass(frozen=True)
class Start:
    """The start of a trajectory: initial state [n], its values of the constants [K], and their origin."""

    state: Array
    constants: Array
    origin: Origin
    failure: str = ""


@dataclass(frozen=True)
class Prediction:
    """The solution of one trajectory at its rows: states [R, n] and channels [R, C]; NaN from the row where it failed.

    `failure` is the reason for a failure, or empty.
    """

    label: str
    start: Start
    times: Array
    states: Array
    channels: Array
    failure: str = ""


def needed(model: Model, item: Trajectory) -> tuple[int, ...]:
    """The states whose initial value is neither given by the model nor measured in the first row."""
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
    """The state `otherwise` [n], with the entries replaced that the first row measures."""
    state = otherwise.copy()
    if len(item.times) and item.times[0] == item.start:
        for j, channel in enumerate(model.channels):
            if channel.state is not None and np.isfinite(item.values[0, j]):
                state[channel.state] = item.values[0, j]
    return state


def learned_positions(member: GeneratedModule, trajectories: Trajectories, data: DataRecord | None) -> list[int | None]:
    """The index of each trajectory in the training data of a member, found by content; None for a new one. Of several
    with the same content it is the one with the same label, if there is one.

    The member's `info` holds the fingerprints of its trajectories; without them, a table with the same SHA-256 as the
    training data (`data` of `fit.json`) has the same trajectories in the same order.
    """
    known = member.info.get("fingerprints")
    count = len(member.weights.get("initial", ()))
    if known:
        table = {content: position for position, content in enumerate(known)}
        pairs = zip(known, labels_of(member), strict=False)
        labelled = {pair: position for position, pair in enumerate(pairs)}
        contents = [fingerprint(item) for item in trajectories.items]
        named = zip(contents, (item.label for item in trajectories.items), strict=True)
        return [labelled.get(pair, table.get(pair[0])) for pair in named]
    recorded = "" if data is None else data.sha256
    same = bool(recorded) and trajectories.sha256 == recorded and count == len(trajectories)
    return [i if same else None for i in range(len(trajectories))]


def labels_of(member: GeneratedModule) -> Sequence[str]:
    """The labels of the trajectories of a member's training data; none in runs of old versions."""
    return tuple(map(str, member.info.get("labels") or ()))


def continued_positions(
    member: GeneratedModule, trajectories: Trajectories, data: DataRecord | None
) -> list[tuple[int, int] | None]:
    """For each trajectory that begins with the rows of one of the training data and goes on, the index of that one and
    the number of rows up to its end; None for others. Rows without a measurement after the last one that has some go
    on too: they are as little of the training as rows that were measured later. A single row is no beginning of one
    with another label."""
    learned, labels = learned_positions(member, trajectories, data), labels_of(member)
    longer = continued(member.info.get("beginnings"), trajectories.items)
    found: list[tuple[int, int] | None] = []
    for position, begun, item in zip(learned, longer, trajectories.items, strict=True):
        if position is None:
            found.append(begun)
        else:
            measured = measured_rows(item)
            end, named = int(measured.max(initial=-1)) + 1, not labels or labels[position] == item.label
            begins = len(measured) > 1 or (len(measured) == 1 and named)
            found.append((position, end) if begins and end < len(item.times) else None)
    return found


def learned_start(evaluator: Evaluator, position: int, item: Trajectory, origin: Origin = "learned") -> Start:
    """The learned start of the trajectory at this index of the training data."""
    member = evaluator.instance
    constants = own_constants(evaluator, position)
    state = np.array(member.weights["initial"][position], dtype=float)
    return started(evaluator, item, state, constants, origin)


def started(evaluator: Evaluator, item: Trajectory, state: Array, constants: Array, origin: Origin) -> Start:
    """A start from the values [n] of what is neither given nor steady; a failure is reported, not raised."""
    try:
        found = evaluator.initial(state, item.condition, constants, item.inputs, item.start)
    except ComputationError as error:
        return Start(state, constants, "failed", error.what)
    return Start(found, constants, origin)


def own_constants(evaluator: Evaluator, position: int) -> Array:
    """The constants [K] of one training trajectory: the shared ones, and its own values of per-trajectory constants."""
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
        states, late = evaluator.followed(
            start.state,
            item.times,
            item.condition,
            item.inputs,
            item.start,
            doses=item.doses,
            constants=start.constants,
            rtol=rtol,
            atol=rtol * (IN_LOGARITHMS if logarithmic(model).any() else 1.0),
            scales=scales,
        )
    except ComputationError as error:
        return Prediction(item.label, start, item.times, *empty, f"{error.what} ({error.where})")
    return completed(evaluator, model, item, start, states, late)


def completed(
    evaluator: Evaluator, model: Model, item: Trajectory, start: Start, states: Array, late: Array | None = None
) -> Prediction:
    """The solution with the channels at its states [R, n]; `late` [R, d] are delayed values, which models without
    delays do not have."""
    inputs = input_values(model, item, item.times)
    inputs = inputs if late is None else np.hstack([inputs, late])
    channels = evaluator.observe_many(item.times, states, item.condition, inputs, start.constants)
    if not np.isfinite(channels).all():
        return Prediction(item.label, start, item.times, states, channels, "a channel is not finite")
    return Prediction(item.label, start, item.times, states, channels)


def input_values(model: Model, item: Trajectory, times: Array) -> Array:
    """The inputs [T, m] of a trajectory at `times`."""
    columns = [
        evaluate(signal, one.interpolation, times) for signal, one in zip(item.inputs, model.inputs, strict=True)
    ]
    return np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))


def extrapolated(
    known: Extrapolation | None, model: Model, item: Trajectory, states: Array, start: Start
) -> dict[str, Mask]:
    """For each unknown the rows [R] in which it is extrapolated along a solution; empty if that is not known."""
    if known is None or not len(states):
        return {}
    inputs = input_values(model, item, item.times)
    return known.functions(item.times, states, item.condition, inputs, start.constants)


def mean_prediction(predictions: Sequence[Prediction]) -> Prediction:
    """The mean of several members' predictions of one trajectory; it fails if one of them does."""
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
