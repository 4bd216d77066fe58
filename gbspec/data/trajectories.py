"""Measured trajectories in memory: the content of a table, independent of its layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.data.columns import TRAJECTORY, Form
from gbspec.frames import Tabled, counted

if TYPE_CHECKING:
    import polars as pl


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
class Limits:
    """Censored entries [R, C]: the `value` of each limit (NaN: none), and the `side` of it on which the measured value
    lies: -1 below, 1 above, 0 without a limit."""

    value: Array
    side: NDArray[np.int8]

    def rows(self, chosen: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Limits:
        """Those of some of the rows."""
        return Limits(self.value[chosen], self.side[chosen])


@dataclass(frozen=True)
class RunIn:
    """The regimen before a trajectory's first row, so long that the solution is periodic then: a number of doses, at
    equal intervals."""

    interval: float
    doses: int

    @property
    def duration(self) -> float:
        """How long it lasts."""
        return self.interval * self.doses


@dataclass(frozen=True)
class Trajectory:
    """One trajectory of R rows and C channels, float64.

    `start` is its start time (the model's `from`, else the first row's time); `times` [R] strictly increase and have
    each row with a measurement; `values` [R, C] is NaN where a channel was not measured (replicates are averaged, of
    channels with log-normal noise by the geometric mean);
    `counts` [R, C] is the number of measurements that an entry averages (0 where none); `sd` [R, C] is the standard
    deviation of the entry if the data have one, else NaN. `condition` [n_conditions]; `inputs` and `doses` follow the
    model's order. `end` is the last of `times`. `run_in`: with what the time from `start` to `begins` is filled, so
    that a steady state is reached; None without one. `limits` are its censored entries, which have no value and count
    as one measurement; None without any. `scatter` [R, C] is the sum of squared deviations of an entry's replicates
    from their average (log-normal noise: of their logarithms, times the average squared); None without replicates.
    `assumed` are the indices of conditions of which the table has no value, so that `condition` has their default.
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
    run_in: RunIn | None = None
    limits: Limits | None = None
    scatter: Array | None = None
    assumed: tuple[int, ...] = ()

    def at_rows(self, chosen: slice | Mask) -> Trajectory:
        """The trajectory with some of its rows; what is not measured stays."""
        return replace(
            self,
            times=self.times[chosen],
            values=self.values[chosen],
            counts=self.counts[chosen],
            sd=self.sd[chosen],
            limits=None if self.limits is None else self.limits.rows(chosen),
            scatter=None if self.scatter is None else self.scatter[chosen],
        )

    @property
    def censored(self) -> Limits:
        """Its censored entries, of which there may be none."""
        none = np.full(self.values.shape, np.nan), np.zeros(self.values.shape, dtype=np.int8)
        return Limits(*none) if self.limits is None else self.limits

    @property
    def begins(self) -> float:
        """When the trajectory of the table begins: its start, after what leads to a steady state."""
        return self.start if self.run_in is None else self.start + self.run_in.duration

    @property
    def end(self) -> float:
        """The last measured time (the start, if there is none)."""
        return float(self.times[-1]) if len(self.times) else self.start


@dataclass(frozen=True, repr=False)
class Trajectories(Tabled):
    """A data set for one model. `channels` names the columns of `values`; `path`, `sha256` identify the file.

    `form` names the columns of `to_frame`.
    """

    items: tuple[Trajectory, ...]
    channels: tuple[str, ...]
    path: str = ""
    sha256: str = ""
    rows: int = 0
    meta: dict[str, str] = field(default_factory=dict)
    form: Form | None = field(default=None, compare=False)

    def __len__(self) -> int:
        return len(self.items)

    @property
    def measurements(self) -> int:
        """Number of measured values."""
        return int(sum(np.sum(item.counts) for item in self.items))

    def with_defaults(self, defaults: Sequence[float | None]) -> Trajectories:
        """The data with other `defaults` [n_conditions]: conditions that the table has no value of have them."""
        items = []
        for item in self.items:
            condition = item.condition.copy()
            for i in item.assumed:
                condition[i] = np.nan if defaults[i] is None else defaults[i]
            items.append(replace(item, condition=condition))
        return replace(self, items=tuple(items))

    def subset(self, indices: Sequence[int]) -> Trajectories:
        """The data set reduced to some of its trajectories; unless it is the whole one, it is in no file."""
        items = tuple(self.items[i] for i in indices)
        if len(items) == len(self.items) and list(indices) == list(range(len(items))):
            return self
        return Trajectories(items, self.channels, meta=dict(self.meta), form=self.form)

    def to_frame(self) -> pl.DataFrame:
        """One row for each trajectory and time, as in a table of the wide layout; null where nothing was measured.

        Columns: `trajectory`, the time, channels, `sd_…` if there is any, conditions, inputs, doses.
        """
        if self.form is None:
            raise ValueError("these trajectories do not know the names of their columns; read or simulate them")
        return frame_of(self, self.form)

    def summary(self) -> str:
        """The numbers of trajectories and of measured values, and the channels."""
        count = counted(len(self), "trajectory")
        return f"{count}, {counted(self.measurements, 'value')} of {', '.join(self.channels)}"


def frame_of(trajectories: Trajectories, form: Form) -> pl.DataFrame:
    """The trajectories as a data frame of the wide layout; null where nothing was measured."""
    import polars as pl

    blocks = [_block(item, form) for item in trajectories.items]
    names = [form.time, *(q.column for q in form.quantities)]
    width = len(names)
    stacked = np.concatenate(blocks) if blocks else np.zeros((0, width))
    labels = [item.label for item, block in zip(trajectories.items, blocks, strict=True) for _ in range(len(block))]
    columns = {TRAJECTORY: pl.Series(labels, dtype=pl.String)}
    names_of = {quantity.column: quantity.categories for quantity in form.quantities}
    for name, values in zip(names, stacked.T, strict=True):
        if name.startswith(("sd_", "limit_")) and np.isnan(values).all():
            continue
        columns[name] = pl.Series(values, dtype=pl.Float64).fill_nan(None)
        if names_of.get(name):
            known = dict(enumerate(names_of[name]))
            columns[name] = columns[name].replace_strict(list(known), list(known.values()), return_dtype=pl.String)
    return pl.DataFrame(columns)


def _block(item: Trajectory, form: Form) -> Array:
    """One trajectory's rows [R, 1 + quantities]; NaN where a cell is empty."""
    moments = [item.times, *(s.times for s in item.inputs), *(d.times for d in item.doses)]
    first = min((float(times[0]) for times in moments if len(times)), default=np.inf)
    if not form.starts and item.start < first:
        moments.append(np.array([item.start]))
    times = np.unique(np.concatenate(moments))
    columns = [times]
    at = np.searchsorted(times, item.times)
    for quantity in form.quantities:
        cells = np.full(len(times), np.nan)
        match quantity.role:
            case "channel":
                limits = item.censored
                known = limits.side[:, quantity.index] == 0
                cells[at] = np.where(known, item.values[:, quantity.index], limits.value[:, quantity.index])
            case "sd":
                cells[at] = item.sd[:, quantity.index]
            case "limit":
                side = item.censored.side[:, quantity.index]
                cells[at] = np.where(side == 0, np.nan, side)
            case "condition":
                cells[:] = item.condition[quantity.index]
            case "input":
                signal = item.inputs[quantity.index]
                cells[np.searchsorted(times, signal.times)] = signal.values
            case "dose":
                events = item.doses[quantity.index]
                cells[np.searchsorted(times, events.times)] = 0.0
                np.add.at(cells, np.searchsorted(times, events.times), events.amounts)
        columns.append(cells)
    return np.stack(columns, axis=1)
