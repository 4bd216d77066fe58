"""The search of a filter's moments: what is computed at a guess of them, until the guess is what it leads to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.engines.filter.compiled import Advance
from gbspec.training.engines.filter.legs import Legs
from gbspec.training.engines.filter.recursion import Flow, Kept, Moment, Reading, part_of, put
from gbspec.training.engines.filter.result import Filtered
from gbspec.training.problem import Integers

TOLERANCE = 1e-10
"""The guess of the moments is exact when it moves by less, in typical sizes of the states."""
PASSES, WINDOW = 25, 16
"""After this many passes over all rows the rest is done in windows of this many places, which cannot take longer than
one place after the other."""


@dataclass
class Search:
    """The search at one vector: `flows` of legs and `readings` of rows at given moments, the moments `start` of the
    trajectories, which values are `seen`, and in `found` the guess, which becomes the filter."""

    legs: Legs
    scale: Array
    flows: Callable[[Integers, Moment], Flow]
    readings: Callable[[Integers, Moment], Reading]
    advance: Advance
    start: Moment
    seen: Mask
    found: Filtered

    def __post_init__(self) -> None:
        self.flow: Flow | None = None
        self.reading: Reading | None = None
        # Legs and rows whose guess has moved since they were computed.
        self.old_legs, self.old_rows = np.ones(len(self.legs.owner), dtype=bool), np.ones(len(self.seen), dtype=bool)

    def run(self, once: bool) -> None:
        """The filter's moments; with `once` those of the flows and readings at the guess."""
        place, window, passes, places = 0, self.legs.places, 0, self.legs.places
        while place < places:
            place = self._pass(place, min(place + window, places))
            passes += 1
            if once:
                break
            if passes > PASSES:
                window = WINDOW
        self.found.finish(self.seen)

    def again(self, changed: Integers) -> None:
        """The same where the flows of some legs are others now."""
        self.old_legs[changed], self.found.value = True, float("inf")
        self.run(once=False)

    def _pass(self, begin: int, end: int) -> int:
        """One pass over the places from `begin` to `end`; the first place whose guess was not exact."""
        legs, found = self.legs, self.found
        index = np.arange(legs.begins[begin], legs.begins[end])
        rows, place = legs.rows_of(index)
        ends = index[place >= 0]
        legs_now, rows_now = index[self.old_legs[index]], self.old_rows[rows]
        if len(legs_now):
            flow = self.flows(legs_now, found.moments(legs_now))
            flow = _sound(flow, found.bad, legs_now)
            self.flow = put(self.flow or part_of(flow, np.zeros_like(legs.owner)), legs_now, flow)
        if rows_now.any():
            reading = self.readings(rows[rows_now], found.moments(ends[rows_now], True))
            every = np.zeros(len(self.seen), dtype=np.int64)
            self.reading = put(self.reading or part_of(reading, every), rows[rows_now], reading)
        if self.flow is None or self.reading is None:
            return end
        flows, readings = part_of(self.flow, index), part_of(self.reading, rows)
        moment = Moment(self.start.m.copy(), self.start.p.copy()) if begin == 0 else self._stored(begin)
        kept = Kept.empty(len(index), len(self.scale))
        innovations = self.advance(moment, legs.owner[index], flows, readings, place, kept)
        found.put(index, kept, flows.a, rows, innovations)
        moved = self._moved(kept.before, flows)
        moved_rows = self._moved(kept.end.of(np.flatnonzero(place >= 0)), readings)
        self.old_legs[index], self.old_rows[rows] = moved, moved_rows
        moved[place >= 0] |= moved_rows
        if not moved.any():
            return end
        return int(np.searchsorted(legs.begins, index[np.argmax(moved)], side="right")) - 1

    def _stored(self, place: int) -> Moment:
        """The moments of all trajectories at the ends of the place before; of those that have ended, any."""
        owner, span = self.legs.owner, self.legs.at(place - 1)
        moment = Moment(self.start.m.copy(), self.start.p.copy())
        moment.put(owner[span], Moment(self.found.post_mean[span], self.found.post_cov[span]))
        return moment

    def _moved(self, new: Moment, used: Flow | Reading) -> Mask:
        """Which moments differ from those that flows or readings were computed at [B]; what is not finite cannot get
        better."""
        with np.errstate(invalid="ignore"):
            moved = (np.abs(new.m - used.at) > TOLERANCE * (self.scale + np.abs(new.m))).any(axis=1)
            if used.cov is not None:
                sd = np.sqrt(np.abs(np.diagonal(new.p, axis1=1, axis2=2)))
                size = np.outer(self.scale, self.scale) + sd[:, :, None] * sd[:, None]
                moved |= (np.abs(new.p - used.cov) > TOLERANCE * size).any(axis=(1, 2))
        return np.asarray(moved, dtype=np.bool_)


def _sound(flows: Flow, bad: Mask, index: Integers) -> Flow:
    """The flows, with those that are not finite replaced by standing still, and marked."""
    parts = (flows.mean, flows.a.reshape(len(index), -1), flows.q.reshape(len(index), -1))
    wrong = ~np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)
    bad[index] = wrong
    if not wrong.any():
        return flows
    mean, a, q = flows.mean.copy(), flows.a.copy(), flows.q.copy()
    mean[wrong], a[wrong], q[wrong] = flows.at[wrong], np.eye(mean.shape[1]), 0.0
    return replace(flows, mean=mean, a=a, q=q)
