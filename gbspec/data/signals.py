"""Inputs over time: their values, with the limits from either side of a jump, and where they break."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gbspec.arrays import Array
from gbspec.data.trajectories import Signal

Interpolation = Literal["held", "linear"]
Side = Literal["left", "right"]


def evaluate(signal: Signal, interpolation: Interpolation, t: ArrayLike, side: Side = "right") -> Array:
    """The input's value at times `t` (any shape).

    At a jump of a held input, `side` "right" gives the value from there on (what a step that begins there sees), "left"
    the one before (what a step that ends there sees). The first value holds before the first time, the last after the
    last; an input without any value is zero.
    """
    moments = np.asarray(t, dtype=np.float64)
    if not len(signal.times):
        return np.zeros_like(moments)
    if interpolation == "linear":
        return np.interp(moments, signal.times, signal.values)
    index = np.searchsorted(signal.times, moments, side=side) - 1
    values: Array = signal.values[np.clip(index, 0, len(signal.values) - 1)]
    return values


def breakpoints(signal: Signal, interpolation: Interpolation, start: float, end: float) -> Array:
    """The times strictly between `start` and `end` where the input jumps (held) or has a kink (linear), increasing.

    A solver's step must not go across them, or it loses its order.
    """
    if len(signal.times) < 2:
        return np.zeros(0)
    times, values = signal.times, signal.values
    if interpolation == "held":
        broken = times[1:][values[1:] != values[:-1]]
    else:
        slopes = np.concatenate([[0.0], np.diff(values) / np.diff(times), [0.0]])
        broken = times[slopes[1:] != slopes[:-1]]
    inside: Array = broken[(broken > start) & (broken < end)]
    return inside


def clipped(signal: Signal, interpolation: Interpolation, start: float, end: float) -> Signal:
    """The signal from `start` to `end` alone, with its value at `start`, and for a linear one that at `end`."""
    inside = (signal.times > start) & (signal.times <= end)
    times = np.concatenate([[start], signal.times[inside]])
    values = np.concatenate([[evaluate(signal, interpolation, start)], signal.values[inside]])
    if interpolation == "linear" and times[-1] < end:
        times = np.append(times, end)
        values = np.append(values, evaluate(signal, interpolation, end))
    return Signal(times, values)
