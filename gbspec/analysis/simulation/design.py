"""Designs of simulated experiments: initial states, conditions, inputs, and the measurement times of each channel.

Each trajectory has its own random generator, so that it does not depend on how many others are drawn or drawn again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import Box, DoseEvents, Signal, SimulateOptions, Trajectory, clipped, lasting, regimen, similar
from gbspec.diagnostics import Findings
from gbspec.ir import Model, Range, not_categories, whole

SHAPE = 4.0
"""Shape of the gamma distribution of intervals (standard deviation: half the mean)."""
PIECES = 5
"""The mean number of values of a random input in a trajectory."""


@dataclass(frozen=True)
class Boxes:
    """The boxes from which initial states, conditions and inputs are drawn: low and high ends, [n, 2] each, in the
    model's order. An initial value that the model gives has NaN.
    """

    states: Array
    conditions: Array
    inputs: Array


@dataclass(frozen=True)
class Plan:
    """One trajectory before it is solved: initial state, conditions, inputs, doses, and measurement times.

    It is solved from time `start` and recorded from `begins`. `x0` [n] is used for states whose initial value the model
    does not give; `times` [T] increase, `mask` [T, channels] marks what is measured.
    """

    label: str
    start: float
    begins: float
    x0: Array
    condition: Array
    inputs: tuple[Signal, ...]
    doses: tuple[DoseEvents, ...]
    times: Array
    mask: Mask


# ---------------------------------------------------------------------------------------------------------- boxes


def boxes(model: Model, options: SimulateOptions, findings: Findings, given: bool = False) -> Boxes:
    """The boxes from the options and the declared ranges.

    Reports unknown names (GB751), initial values that the model gives (GB752), quantities without a range (GB753),
    and numbers of no category (GB383).
    `given`: conditions and inputs come from a table and need no range.
    """
    starts = {s.name: _declared(s.range, s.start) for s in model.states if not s.initial.known}
    expressed = {state.name for state in model.states if state.initial.known}
    conditions = {item.name: _declared(item.range, item.default) for item in model.conditions}
    inputs = {item.name: _declared(item.range, item.default) for item in model.inputs}
    _known(options.initial, starts, expressed, "--initial", "state", findings)
    _known(options.condition, conditions | inputs, set(), "--condition", "condition or input", findings)
    findings.extend(not_categories(model.conditions, options.condition))
    channels = {channel.name: None for channel in model.channels}
    _known(dict.fromkeys(options.clock, (0.0, 0.0)), channels, set(), "--clock", "channel", findings)
    dosed: dict[str, Box | None] = {dose.state: None for dose in model.doses}
    _known(dict.fromkeys(options.dose, (0.0, 0.0)), dosed, set(), "--dose", "dose into a state", findings)
    external: dict[str, Box | None] = {} if given else conditions | inputs
    for flag, kind, ranges, chosen in (
        ("--initial", "state", starts, options.initial),
        ("--condition", "condition or input", external, options.condition),
    ):
        for name, box in ranges.items():
            if box is None and name not in chosen:
                findings.error(
                    "GB753",
                    f"there is neither a range nor a value from which the {kind} `{name}` could be drawn",
                    None,
                    help=f"add `{flag} {name}=LOW:HIGH`, or declare a range in the model: `{name} in [LOW, HIGH]`",
                    subject=name,
                )
    return Boxes(
        _array([state.name for state in model.states], starts, options.initial),
        _array(list(conditions), conditions, options.condition),
        _array(list(inputs), inputs, options.condition),
    )


def _declared(range: Range | None, value: float | None) -> Box | None:
    """A declared range if it is bounded, else a single value, else nothing."""
    if range is not None and range.bounded:
        return (range.low, range.high)
    return None if value is None else (value, value)


def _known(
    chosen: Mapping[str, Box],
    known: Mapping[str, Box | None],
    expressed: set[str],
    flag: str,
    kind: str,
    findings: Findings,
) -> None:
    """Reports boxes for names that cannot have one."""
    for name in chosen:
        if name in expressed:
            findings.error(
                "GB752",
                f"`{flag} {name}=…`: the model gives the initial value of `{name}`",
                None,
                help=f"remove `initial {name} = …` from the model, or change what it says with `--set`",
                subject=name,
            )
        elif name not in known:
            meant = similar(name, known)
            findings.error(
                "GB751",
                f"`{flag} {name}=…`: the model has no {kind} `{name}`",
                None,
                help=f"is `{meant}` meant?" if meant else f"it has {', '.join(known) or 'none'}",
                subject=name,
            )


def _array(names: Sequence[str], declared: Mapping[str, Box | None], chosen: Mapping[str, Box]) -> Array:
    """Ends of the boxes, [names, 2]; NaN for names without a box."""
    nothing = (np.nan, np.nan)
    found = [tuple(chosen.get(name, ())) or declared.get(name) or nothing for name in names]
    return np.array(found, dtype=float).reshape(-1, 2)


# ---------------------------------------------------------------------------------------------------------- plans


def draw(box: Array, random: np.random.Generator) -> Array:
    """A point drawn from the uniform distribution on a box [n, 2]; NaN stays NaN."""
    return box[:, 0] + (box[:, 1] - box[:, 0]) * random.random(len(box))


def plan(model: Model, options: SimulateOptions, box: Boxes, label: str, random: np.random.Generator) -> Plan | None:
    """Draws one trajectory; None if fewer than two times are in the span."""
    start = model.time.start or 0.0
    times, mask = measurement_times(options, tuple(channel.name for channel in model.channels), start, random)
    if len(times) < 2:
        return None
    end = start + options.span
    inputs = tuple(
        random_signal(item.interpolation, ends, start, end, random)
        for item, ends in zip(model.inputs, box.inputs, strict=True)
    )
    x0, condition = draw(box.states, random), whole(model.conditions, draw(box.conditions, random))
    doses = tuple(drawn_doses(options.dose.get(dose.state), start, end, random) for dose in model.doses)
    first = min([float(times[0]), *(events.times[0] for events in doses if len(events.times))])
    doses, inputs = lasting(model, condition, doses, inputs, options.dose, (start, end))
    # An initial value that the model gives holds at time `start`, so that the table must begin there.
    fixed = model.time.start is not None or any(state.initial.known for state in model.states)
    begins = start if fixed else first
    return Plan(label, start, begins, x0, condition, inputs, doses, times, mask)


def drawn_doses(text: str | None, start: float, end: float, random: np.random.Generator) -> DoseEvents:
    """The doses of a regimen (none without one) between `start` and `end`."""
    if text is None:
        return DoseEvents(np.zeros(0), np.zeros(0))
    given = regimen(text)
    times = np.unique([time for time in given.times if start <= time <= end])
    low, high = given.amount
    return DoseEvents(times, low + (high - low) * random.random(len(times)))


def plan_like(
    item: Trajectory, model: Model, options: SimulateOptions, box: Boxes, random: np.random.Generator
) -> Plan:
    """Times, conditions, inputs and doses of a trajectory of a table, except those that the options draw.

    The same values are measured as in the table; if it measures nothing, all channels at all times.
    """
    mask = item.counts > 0
    if not mask.any():
        mask = np.ones_like(mask)
    chosen = np.array([condition.name in options.condition for condition in model.conditions], dtype=bool)
    condition = np.where(chosen, whole(model.conditions, draw(box.conditions, random)), item.condition)
    used = mask.any(axis=1)
    doses = tuple(
        drawn_doses(options.dose[dose.state], item.start, item.end, random) if dose.state in options.dose else events
        for dose, events in zip(model.doses, item.doses, strict=True)
    )
    doses, inputs = lasting(model, condition, doses, item.inputs, options.dose, (item.start, item.end))
    return Plan(
        label=item.label,
        start=item.start,
        begins=item.start,
        x0=draw(box.states, random),
        condition=condition,
        inputs=inputs,
        doses=doses,
        times=item.times[used],
        mask=mask[used],
    )


def random_signal(interpolation: str, ends: Array, start: float, end: float, random: np.random.Generator) -> Signal:
    """An input with values drawn uniformly from its range, at gamma-distributed intervals (mean: span/5).

    A held input steps from one value to the next; a linear one interpolates them.
    """
    if ends[0] == ends[1]:
        return Signal(np.array([start]), np.array([ends[0]]))
    times = [start]
    while times[-1] < end:
        times.append(times[-1] + float(random.gamma(SHAPE, (end - start) / PIECES / SHAPE)))
    values = ends[0] + (ends[1] - ends[0]) * random.random(len(times))
    signal = Signal(np.array(times), values)
    return clipped(signal, "held" if interpolation == "held" else "linear", start, end)


def measurement_times(
    options: SimulateOptions, channels: tuple[str, ...], start: float, random: np.random.Generator
) -> tuple[Array, Mask]:
    """The measurement times [T] and mask [T, channels].

    All channels share their times, unless each has its own clock (regular clocks then begin at a random time within
    their first interval, or at the start if intervals are given per channel). At the start, if it is recorded, all
    channels are measured.
    """
    if options.channels == "own-clock":
        own = [_clock(options, options.clock.get(name, options.dt), random, not options.clock) for name in channels]
        ticks = np.unique(np.concatenate(own)) if own else np.zeros(0)
        mask = np.stack([np.isin(ticks, clock) for clock in own], axis=1) if own else np.zeros((0, 0), dtype=bool)
    else:
        ticks = _clock(options, options.dt, random, False)
        mask = np.ones((len(ticks), len(channels)), dtype=bool)
        if options.fraction is not None:
            mask = random.random(mask.shape) < options.fraction
            empty = np.flatnonzero(~mask.any(axis=1))
            mask[empty, random.integers(0, len(channels), len(empty))] = True
    if options.keep_start:
        ticks = np.concatenate([[0.0], ticks])
        mask = np.concatenate([np.ones((1, len(channels)), dtype=bool), mask])
    return start + ticks, mask


def _clock(options: SimulateOptions, interval: float, random: np.random.Generator, phase: bool) -> Array:
    """The ticks of one clock after zero and up to the span; with `phase` the first is random within an interval."""
    if options.sampling == "regular":
        offset = random.random() * interval if phase else interval
        count = int(np.floor((options.span - offset) / interval + 1e-9)) + 1
        return np.asarray(offset + interval * np.arange(max(count, 0)), dtype=np.float64)
    ticks: list[float] = []
    now = float(random.gamma(SHAPE, interval / SHAPE))
    while now <= options.span:
        ticks.append(now)
        now += float(random.gamma(SHAPE, interval / SHAPE))
    return np.array(ticks)
