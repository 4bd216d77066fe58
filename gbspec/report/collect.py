"""The content of figures from a run and its data: solutions of all members and of the truth, values of the unknowns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import sympy

from gbspec.analysis import (
    InitialStates,
    Start,
    input_values,
    learned_positions,
    learned_start,
    predict,
    refitting,
    system_of,
)
from gbspec.analysis import initial_states as compare_starts
from gbspec.arrays import Array
from gbspec.backends import Evaluator, load_module, network_arguments
from gbspec.data import Trajectories, Trajectory, evaluate, present_values
from gbspec.ir import Channel, Condition, Model
from gbspec.ir import residuals as residuals_of
from gbspec.passes import with_truth
from gbspec.report.content import (
    ChannelFit,
    Given,
    History,
    LearnedConstant,
    Orbit,
    OwnConstant,
    Residuals,
    TrajectoryFit,
)
from gbspec.runs import PopulationTables, Run, files, read_tables

DENSE, DENSEST = 240, 8000
"""Smallest and largest number of points of a curve over one trajectory; between them, twice the number of its rows."""
TURN = 10.0
"""Length of a path, in its extents, for which `DENSE` points are enough: about three turns."""
FINE = 8
"""Factor on the number of solution points if evenly spaced points along the path are then selected."""


class Fitted:
    """A run applied to a data set: the evaluator of each member, and each trajectory's initial state under it."""

    def __init__(self, run: Run, data: Trajectories) -> None:
        self.run, self.data, self.model = run, data, run.model
        self.evaluators = [Evaluator(member) for member in run.members]
        self.scales = run.fit.scales_for(self.model, data)
        self.truth = self._truth()
        self._starts: dict[tuple[int, int], Start] = {}

    def _truth(self) -> Evaluator | None:
        """The evaluator of the model's truth, None where an unknown or a learnable has none."""
        model = self.model
        known = {t.name for t in model.truth_constants}
        if not model.has_truth or not (model.unknowns or known) or any(k.name not in known for k in model.learnables):
            return None
        return Evaluator(load_module(with_truth(model))())

    def start(self, member: int, index: int) -> Start:
        """The initial state of trajectory `index` under a member: learned, known, or estimated from its own data."""
        if (member, index) not in self._starts:
            evaluator, item = self.evaluators[member], self.data.items[index]
            position = learned_positions(evaluator.instance, self.data, self.run.fit.data)[index]
            if position is not None:
                found = learned_start(evaluator, position, item)
            else:
                found = refitting(evaluator, self.model, self.run.fit, self.scales).start(item)
            self._starts[member, index] = found
        return self._starts[member, index]

    def solutions(self, index: int, times: Array) -> tuple[Array, Array]:
        """States [M, T, n] and channels [M, T, C] of every member over one trajectory; NaN where one fails."""
        item = at_times(self.data.items[index], times)
        found = [predict(e, self.model, item, self.start(m, index)) for m, e in enumerate(self.evaluators)]
        return np.stack([one.states for one in found]), np.stack([one.channels for one in found])

    def true_solution(self, index: int, times: Array) -> tuple[Array, Array] | None:
        """States and channels of the truth from the same (mean) initial state; None if there is no truth."""
        if self.truth is None:
            return None
        starts = [self.start(m, index).state for m in range(len(self.evaluators))]
        start = Start(np.mean(starts, axis=0), self.truth.constants, "known")
        found = predict(self.truth, self.model, at_times(self.data.items[index], times), start)
        return found.states, found.channels


DIGESTS = 1e9
"""Numbers of groups from here on stand for texts: the first bits of a digest."""


def initial_states(fitted: Fitted, indices: Sequence[int]) -> InitialStates:
    """The first member's initial states of these trajectories, with bred and true ones. Raises `UserError` (GB876)."""
    evaluator, model = fitted.evaluators[0], fitted.model
    system = system_of(evaluator, model)
    return compare_starts(evaluator, model, fitted.data, fitted.run.fit.data, system, fitted.truth, indices)


def at_times(item: Trajectory, times: Array) -> Trajectory:
    """The trajectory with other rows: its conditions, inputs and doses at `times` [T], nothing measured."""
    shape = (len(times), item.values.shape[1])
    nothing = np.full(shape, np.nan)
    return replace(item, times=times, values=nothing, counts=np.zeros(shape), sd=nothing, limits=None, scatter=None)


def dense_times(item: Trajectory) -> Array:
    """Times of a curve over a trajectory; a dose, where the curve may jump, has one before it and one just after."""
    if not item.end > item.begins:
        return np.array([item.begins])
    grid = np.linspace(item.begins, item.end, int(np.clip(2 * len(item.times), DENSE, DENSEST)))
    doses = np.concatenate([np.zeros(0), *(events.times for events in item.doses)])
    doses = doses[(doses >= item.begins) & (doses < item.end)]
    return np.unique(np.concatenate([grid, doses, doses + 1e-9 * (item.end - item.begins)])) if len(doses) else grid


def units(model: Model) -> dict[str, str]:
    """The unit of every declared name that has one, and that of the time."""
    groups = (model.states, model.conditions, model.inputs, model.constants, model.learnables, model.unknowns,
              model.tables, model.intermediates, model.algebraics, model.processes, model.channels,
              (model.time,))  # fmt: skip
    return {item.name: item.unit for group in groups for item in group if item.unit}


def trajectory_fits(fitted: Fitted, indices: Sequence[int], *, hidden: bool = False) -> tuple[TrajectoryFit, ...]:
    """Measurements and curves of these trajectories; `hidden`: also of the states that no channel measures."""
    return tuple(_trajectory_fit(fitted, index, hidden) for index in indices)


def _trajectory_fit(fitted: Fitted, index: int, hidden: bool) -> TrajectoryFit:
    item, model = fitted.data.items[index], fitted.model
    grid = dense_times(item)
    states, channels = fitted.solutions(index, grid)
    true = fitted.true_solution(index, grid)
    shown = []
    for j, channel in enumerate(model.channels):
        measured = np.isfinite(item.values[:, j])
        reference = None if true is None else true[1][:, j]
        unit = channel_unit(model, channel)
        shown.append(ChannelFit(channel.name, item.times[measured], item.values[measured, j], grid, channels[:, :, j],
                                reference, unit, _limits(item, j, -1), _limits(item, j, 1),
                                solution_label(model)))  # fmt: skip
    for i, state in enumerate(model.states):
        if hidden and all(channel.state != i for channel in model.channels):
            reference, nothing = None if true is None else true[0][:, i], np.zeros(0)
            shown.append(ChannelFit(state.name, nothing, nothing, grid, states[:, :, i], reference, state.unit or "",
                                    solution=solution_label(model)))  # fmt: skip
    # What the model gives was not learned, whatever the rest of the run was
    known = all(state.initial.known for state in model.states)
    origin = "given by the model" if known else fitted.start(0, index).origin
    return TrajectoryFit(item.label, condition_text(model, item), tuple(shown), origin, _given(model, item),
                         _own_text(fitted.run, item.label))  # fmt: skip


def solution_label(model: Model) -> str:
    """What whole solutions are: with random disturbances they are not what the model expects of the measured rows."""
    return "solution without disturbances" if model.diffusions else "model"


def _limits(item: Trajectory, channel: int, side: int) -> Array | None:
    """Times and limits [2, L] of a channel's censored values on a side of their limits; None without any."""
    rows = item.censored.side[:, channel] == side
    return np.stack([item.times[rows], item.censored.value[rows, channel]]) if rows.any() else None


def channel_unit(model: Model, channel: Channel) -> str:
    """The unit of a channel, which is that of the state or of the named value that it measures."""
    measured = channel.value.name if isinstance(channel.value, sympy.Symbol) else ""
    if channel.state is not None:
        measured = model.states[channel.state].name
    return channel.unit or units(model).get(measured, "")


def _given(model: Model, item: Trajectory) -> tuple[Given, ...]:
    """The inputs over the trajectory's time, and the doses in it."""
    found = []
    for signal, one in zip(item.inputs, model.inputs, strict=True):
        inside = signal.times[(signal.times > item.begins) & (signal.times < item.end)]
        times = np.concatenate([[item.begins], inside, [item.end]])
        values = evaluate(signal, one.interpolation, times)
        if one.interpolation == "held":
            before = evaluate(signal, "held", times[1:], "left")
            times = np.repeat(times, 2)[1:-1]
            values = np.column_stack([values[:-1], before]).ravel()
        found.append(Given(one.name, times, values, one.unit or ""))
    for events, dose in zip(item.doses, model.doses, strict=True):
        seen = (events.times >= item.begins) & (events.times <= item.end)
        if seen.any():
            unit = units(model).get(dose.state, "")
            found.append(Given(f"dose, {dose.state}", events.times[seen], events.amounts[seen], unit, doses=True))
    return tuple(found)


def _own_text(run: Run, label: str) -> str:
    """The constants that a trajectory has for itself, with their intervals, in words."""
    known = units(run.model)
    said = []
    for name, entry in run.fit.constants.items():
        own = (entry.per_trajectory or {}).get(label)
        if own is not None:
            unit = f" {known[name]}" if name in known else ""
            between = f" ({own.interval[0]:.3g} to {own.interval[1]:.3g})" if own.interval else ""
            said.append(f"{name} = {own.value:.4g}{between}{unit}")
    return ", ".join(said)


def condition_text(model: Model, item: Trajectory) -> str:
    """The conditions of a trajectory in words; without groups whose texts stand as digests."""
    given = [(c, float(value)) for c, value in zip(model.conditions, item.condition, strict=True)]
    return ", ".join(f"{c.name} = {_given_value(c, v)}" for c, v in given if not (c.labels and v >= DIGESTS))


def _given_value(condition: Condition, value: float) -> str:
    names = condition.categories
    return names[int(value)] if names and 0 <= value < len(names) else f"{value:.3g}"


def residuals(fitted: Fitted) -> tuple[Residuals, ...]:
    """The residuals of whole solutions for the mean of the members, at every measurement, as the training objective has
    them (with random disturbances it has innovations in place of these); of counts those by which a fit is judged."""
    model, data = fitted.model, fitted.data
    scales = fitted.scales
    times = np.concatenate([item.times for item in data.items])
    predicted = np.concatenate([fitted.solutions(k, item.times)[1].mean(axis=0) for k, item in enumerate(data.items)])
    present = present_values(model, data).items
    measured, factor = (
        np.concatenate(each) for each in zip(*((item.values, scales.factor(item)) for item in present), strict=True)
    )
    found = residuals_of(predicted, measured, factor, scales.log)
    shown, number = [], np.concatenate([item.counts for item in present])
    for j, (channel, scale) in enumerate(zip(model.channels, fitted.run.fit.error_scales(model), strict=True)):
        if scale.size is not None:
            found[:, j] = scale.errors(measured[:, j], predicted[:, j], number[:, j])
        seen = (factor[:, j] > 0) & np.isfinite(found[:, j])
        shown.append(Residuals(channel.name, times[seen], predicted[seen, j], found[seen, j], bool(scales.log[j]),
                               channel_unit(model, channel), solution_label(model)))  # fmt: skip
    return tuple(shown)


def orbits(fitted: Fitted, indices: Sequence[int], plane: tuple[int, int]) -> tuple[Orbit, ...]:
    """Trajectories in the plane of two states; measured points are the rows in which channels measure both."""
    columns = [_channel_of(fitted.model, state) for state in plane]
    found = []
    for index in indices:
        item = fitted.data.items[index]
        # Time is not shown, so that a fast turn needs as many points as a slow one of the same length.
        grid = np.linspace(item.begins, item.end, FINE * DENSE) if item.end > item.begins else dense_times(item)
        states, _ = fitted.solutions(index, grid)
        true = fitted.true_solution(index, grid)
        seen = np.zeros((0, 2))
        if None not in columns:
            both = item.values[:, [c for c in columns if c is not None]]
            seen = both[np.isfinite(both).all(axis=1)]
        path = _even(states.mean(axis=0)[:, list(plane)])
        found.append(Orbit(item.label, path, None if true is None else _even(true[0][:, list(plane)]), seen))
    return tuple(found)


def _even(path: Array) -> Array:
    """Points of a path [P, 2], evenly spaced along its length relative to its extent: `DENSE`, more for many turns."""
    extent = np.ptp(path, axis=0)
    steps = np.linalg.norm(np.diff(path, axis=0) / np.where(extent > 0, extent, 1.0), axis=1)
    if len(path) <= DENSE or not np.isfinite(steps).all():
        return path
    along = np.concatenate([[0.0], np.cumsum(steps)])
    count = int(np.clip(DENSE * along[-1] / TURN, DENSE, FINE * DENSE))
    return path[np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], count)))]


def _channel_of(model: Model, state: int) -> int | None:
    return next((j for j, channel in enumerate(model.channels) if channel.state == state), None)


def constants(run: Run) -> tuple[LearnedConstant, ...]:
    """The learned constants of `fit.json` and their true values."""
    truths = {t.name: t.value for t in run.model.truth_constants}
    known = units(run.model)
    return tuple(
        LearnedConstant(
            name,
            entry.value,
            entry.interval,
            entry.per_member,
            entry.start,
            truths.get(name),
            run.profiled(name),
            known.get(name, ""),
        )
        for name, entry in run.fit.constants.items()
    )


def own_constants(run: Run) -> tuple[OwnConstant, ...]:
    """The constants per trajectory of `fit.json`."""
    truths = {t.name: t.value for t in run.model.truth_constants}
    units = {k.name: k.unit or "" for k in run.model.learnables}
    out = []
    for name, entry in run.fit.constants.items():
        own = entry.per_trajectory
        if own:
            values = np.array([one.value for one in own.values()])
            ends = np.array([one.interval or (math.nan, math.nan) for one in own.values()]).T
            out.append(OwnConstant(name, tuple(own), values, ends[0], ends[1], units.get(name, ""), truths.get(name)))
    return tuple(out)


def history(run: Run) -> tuple[History, ...]:
    """The history of every member, in the order of stages, with cumulative time."""
    names = [k.name for k in run.model.learnables if not k.per_trajectory]
    by_member: dict[int, list[dict[str, str]]] = {}
    for row in run.history():
        by_member.setdefault(int(row["member"]), []).append(row)
    return tuple(
        History(
            member,
            tuple(row["stage"] for row in rows),
            np.array([float(row["seconds"]) for row in rows]),
            np.array([_positive(row["loss"]) for row in rows]),
            {name: np.array([float(row[name]) for row in rows]) for name in names if name in rows[0]},
        )
        for member, rows in sorted(by_member.items())
    )


def _positive(text: str) -> float:
    """A loss on a logarithmic axis: NaN (a gap) if it is not positive."""
    value = float(text) if text else math.nan
    return value if value > 0 else math.nan


def visited(fitted: Fitted, network: int, limit: int = 2000) -> Array:
    """The arguments [P, A] with which the model calls a network along its solutions at the measured rows."""
    evaluator = fitted.evaluators[0]
    member = evaluator.instance
    calls: list[Array] = []
    for index, item in enumerate(fitted.data.items):
        states, _ = fitted.solutions(index, item.times)
        rows = np.isfinite(states[0]).all(axis=1)
        x, t = states[0][rows], item.times[rows]
        condition = np.broadcast_to(item.condition, (len(x), len(item.condition)))
        inputs = input_values(fitted.model, item, item.times)[rows]
        own = np.broadcast_to(fitted.start(0, index).constants, (len(x), len(evaluator.constants)))
        calls += network_arguments(member, t, x, condition, inputs, own)[network]
    found = np.concatenate([np.zeros((0, len(fitted.model.networks[network].arguments))), *calls])
    return found[:: max(1, len(found) // limit)]


def population_tables(run: Run) -> PopulationTables | None:
    """The tables of a population fit, of the best member; None where there are none."""
    return read_tables(files.member_directory(run.path, run.best))
