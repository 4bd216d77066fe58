"""Inputs as functions of time: their values, and the limits from either side of a jump."""

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

    At a jump of a held input, `side` "right" gives the value after it (for a step that begins there), "left"
    the one before it (for a step that ends there). The first value holds before the first time, the last after the
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


def clipped(signal: Signal, interpolation: Interpolation, start: float, end: float) -> Signal:
    """The signal restricted to `start` to `end`, with its value at `start`, and for a linear one that at `end`."""
    inside = (signal.times > start) & (signal.times <= end)
    times = np.concatenate([[start], signal.times[inside]])
    values = np.concatenate([[evaluate(signal, interpolation, start)], signal.values[inside]])
    if interpolation == "linear" and times[-1] < end:
        times = np.append(times, end)
        values = np.append(values, evaluate(signal, interpolation, end))
    return Signal(times, values)
