"""Where measured states may jump, in models whose events set them: trajectories are cut there into pieces.

An event at a learned threshold happens between rows, nobody knows in which of them. A curve through all rows has slopes
there that belong to no balance. So each trajectory is divided into pieces that are straight lines up to noise, by
dynamic programming with a penalty for each piece (the optimal partitioning of Jackson and others, 2005, doi
10.1109/LSP.2001.838216). Curvature is cut too, which costs the warm start no more than one interval of many.
"""

from __future__ import annotations

import math

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.ir import Model
from gbspec.training.problem import Integers

LONGEST = 200
"""Rows of the longest piece."""
FINEST = 1e-4
"""Least noise that is assumed, in standard deviations of a state's values."""


def jumping(model: Model) -> list[int]:
    """The states that events with a condition set."""
    names = {name for event in model.events if event.guard is not None for name, _ in event.values}
    return [i for i, state in enumerate(model.states) if state.name in names]


def gaps(model: Model, trajectories: Trajectories, values: list[Array]) -> list[Array]:
    """The times [G, 2] between which each trajectory is cut; `values` [R, n_states] are its measured states (NaN: not
    measured)."""
    both = list(zip(trajectories.items, values, strict=True))
    states = [i for i in jumping(model) if any(np.isfinite(each[:, i]).any() for each in values)]
    if not states:
        return [np.zeros((0, 2)) for _ in values]
    noise = np.array([_noise([(item.times, each[:, i]) for item, each in both]) for i in states])
    out = []
    for item, each in both:
        rows = np.flatnonzero(np.isfinite(each[:, states]).any(axis=1))
        t = item.times[rows]
        first = _partition(t, each[rows][:, states] / noise)
        out.append(np.stack([t[first - 1], t[first]], axis=1))
    return out


def _noise(series: list[tuple[Array, Array]]) -> float:
    """The noise of a state by its changes over the shorter half of all intervals, of which most have no jump."""
    parts = [(times[np.isfinite(values)], values[np.isfinite(values)]) for times, values in series]
    widths, changes = (np.concatenate([np.diff(part[i]) for part in parts]) for i in (0, 1))
    least = FINEST * float(np.std(np.concatenate([values for _, values in parts]))) or 1.0
    if not len(widths):
        return least
    short = widths <= np.median(widths)
    return max(1.4826 * float(np.median(np.abs(changes[short]))) / math.sqrt(2), least)


def _partition(t: Array, y: Array) -> Integers:
    """The rows at which pieces after the first begin, of values [R, S] in units of their noise."""
    count = len(t)
    if count < 3:
        return np.zeros(0, dtype=np.int64)
    sums = _Sums.of((t - t[0]) / (t[-1] - t[0]), y - np.nanmean(y, axis=0))
    penalty = (2 * y.shape[1] + 1) * np.log(max(np.isfinite(y).sum(), 2))
    best, before = np.full(count + 1, np.inf), np.zeros(count + 1, dtype=np.int64)
    best[0] = -penalty
    for end in range(1, count + 1):
        begins = np.arange(max(end - LONGEST, 0), end)
        costs = best[begins] + sums.squares(begins, end) + penalty
        before[end] = begins[int(np.argmin(costs))]
        best[end] = costs.min()
    out, end = [], count
    while end > 0:
        end = int(before[end])
        out.append(end)
    return np.array(out[:-1][::-1], dtype=np.int64)


class _Sums:
    """Sums over rows from which squares of the distances to lines follow."""

    def __init__(self, sums: list[Array]) -> None:
        self.sums = sums

    @classmethod
    def of(cls, t: Array, y: Array) -> _Sums:
        """The sums of rows at times [R] with values [R, S]."""
        seen = np.isfinite(y)
        y, t = np.where(seen, y, 0.0), np.where(seen, t[:, None], 0.0)
        parts = [seen.astype(np.float64), t, t * t, y, t * y, y * y]
        return cls([np.concatenate([np.zeros((1, y.shape[1])), np.cumsum(part, axis=0)]) for part in parts])

    def squares(self, begins: Integers, end: int) -> Array:
        """The sum of squares of the rows from each of `begins` up to `end` around a line for each column."""
        n, t, tt, y, ty, yy = (s[end] - s[begins] for s in self.sums)
        n = np.maximum(n, 1.0)
        spread, together, around = tt - t * t / n, ty - t * y / n, yy - y * y / n
        slope = together / np.where(spread > 1e-14, spread, np.inf)
        return np.asarray(np.maximum(around - slope * together, 0.0).sum(axis=1))
