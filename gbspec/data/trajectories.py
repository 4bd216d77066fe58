"""Measured trajectories in memory: the content of a table, independent of its layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from gbspec.arrays import Array


@dataclass(frozen=True)
class Signal:
    """An input over time: filled cells only. Held: value k from times[k] on; linear: interpolated, ends held."""

    times: Array
    values: Array


@dataclass(frozen=True)
class DoseEvents:
    """Doses into one state: times [n] and amounts [n], in the order of time."""

    times: Array
    amounts: Array


@dataclass(frozen=True)
class Trajectory:
    """One trajectory of R rows and C channels, float64.

    `start` is its start time (the model's `from`, else the first row's time); `times` [R] strictly increase and have
    each row with a measurement; `values` [R, C] is NaN where a channel was not measured (replicates are averaged);
    `counts` [R, C] is the number of measurements that an entry averages (0 where none); `sd` [R, C] is the standard
    deviation of the entry if the data have one, else NaN. `condition` [n_conditions]; `inputs` and `doses` follow the
    model's order. `end` is the last of `times`.
    """

    label: str
    start: float
    times: Array
    values: Array
    counts: Array
    sd: Array
    condition: Array
    inputs: tuple[Signal, ...] = ()
    doses: tuple[DoseEvents, ...] = ()

    @property
    def end(self) -> float:
        """The last measured time (the start, if there is none)."""
        return float(self.times[-1]) if len(self.times) else self.start


@dataclass(frozen=True)
class Trajectories:
    """A data set for one model. `channels` names the columns of `values`; `path`, `sha256` identify the file."""

    items: tuple[Trajectory, ...]
    channels: tuple[str, ...]
    path: str = ""
    sha256: str = ""
    rows: int = 0
    meta: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.items)

    @property
    def measurements(self) -> int:
        """Number of measured values."""
        return int(sum(np.sum(item.counts) for item in self.items))

    def subset(self, indices: Sequence[int]) -> Trajectories:
        """The data set reduced to some of its trajectories; unless it is the whole one, it is in no file."""
        items = tuple(self.items[i] for i in indices)
        if len(items) == len(self.items) and list(indices) == list(range(len(items))):
            return self
        return Trajectories(items, self.channels, meta=dict(self.meta))
