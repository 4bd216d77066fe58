"""The time axis of one trajectory, cut where the slope of an input changes or a dose is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gbspec.arrays import Array
from gbspec.backends.protocol import GeneratedModule
from gbspec.ir import insets, switching_times

_NONE = np.zeros(0)


@dataclass(frozen=True)
class Signal:
    """An input over time: increasing `times` [n] and `values` [n], each held until the next, or interpolated."""

    times: Array
    values: Array


@dataclass(frozen=True)
class Segment:
    """A segment from `begin` to `end`: the inputs are `inputs + slopes*(t - begin)`; `jump` is added to the state at
    `begin`."""

    begin: float
    end: float
    inputs: Array
    slopes: Array
    jump: Array
    insets: tuple[float, float] = (0.0, 0.0)
    """By how much steps stay away from its ends (`ir.insets`)."""


@dataclass(frozen=True)
class Jump:
    """An amount added at a time to the state with the index `state`."""

    time: float
    state: int
    amount: float


ROUNDING = 1e-9
"""An arrival within this fraction of a trajectory's length (or of its last time) of a row arrives at that row."""


def at_rows(jumps: Sequence[Jump], begin: float, rows: Array) -> list[Jump]:
    """The jumps, those within rounding of the beginning or of a row moved there, as in training: a measurement at the
    time of a dose is made before it."""
    places = np.unique(np.append(rows, begin))
    tolerance = ROUNDING * max(float(places[-1]) - begin, abs(float(places[-1])))
    nearest = [float(places[np.argmin(np.abs(places - jump.time))]) for jump in jumps]
    return [
        replace(jump, time=place) if abs(place - jump.time) <= tolerance else jump
        for jump, place in zip(jumps, nearest, strict=True)
    ]


def value_and_slope(signal: Signal, kind: str, time: float) -> tuple[float, float]:
    """A signal's value at a time and its slope just after it; before the first and after the last value it is held."""
    times, values = signal.times, signal.values
    if not len(times):
        raise ValueError("an input has no values")
    i = int(np.searchsorted(times, time, side="right")) - 1
    if i < 0:
        return float(values[0]), 0.0
    if kind == "held" or i == len(times) - 1:
        return float(values[i]), 0.0
    slope = float((values[i + 1] - values[i]) / (times[i + 1] - times[i]))
    return float(values[i]) + slope * (time - float(times[i])), slope


def switches(
    instance: GeneratedModule, begin: float, end: float, condition: Array, constants: tuple[np.float64, ...]
) -> Array:
    """The times from `begin` to `end` at which right sides, or what they see of the past, jump by themselves."""
    equations, m = instance.equations, instance.arithmetic("numpy")
    if not hasattr(equations, "schedule") or not end > begin:
        return _NONE
    return switching_times(lambda t: equations.schedule(m, t, condition, constants), equations.whole, begin, end)


def segments(
    start: float,
    end: float,
    n_states: int,
    inputs: Sequence[Signal],
    kinds: Sequence[str],
    jumps: Sequence[Jump],
    switches: Array = _NONE,
    rows: Array = _NONE,
) -> list[Segment]:
    """The segments of [start, end]: within each, every input is linear in time, no dose is given, and nothing jumps at
    `switches`; those within rounding of `rows` lie there.

    Jumps before `start` are taken as given already; jumps at `end` or later have no effect.
    """
    if not end > start:
        return []
    cuts = {start, end, *(jump.time for jump in jumps)}
    for signal in inputs:
        cuts |= set(map(float, signal.times))
    places = np.array(sorted(place for place in {*cuts, *map(float, rows)} if start <= place <= end))
    places, away = insets(places, switches, ROUNDING * max(end - start, abs(end)))
    bounds = [(float(place), float(by)) for place, by in zip(places, away, strict=True) if place in cuts or by]
    pieces = []
    for (begin, first), (finish, last) in pairwise(bounds):
        pairs = [value_and_slope(signal, kind, begin) for signal, kind in zip(inputs, kinds, strict=True)]
        jump = np.zeros(n_states)
        for item in jumps:
            if item.time == begin:
                jump[item.state] += item.amount
        pieces.append(
            Segment(
                begin,
                finish,
                np.array([v for v, _ in pairs]),
                np.array([slope for _, slope in pairs]),
                jump,
                (first, last),
            )
        )
    return pieces
