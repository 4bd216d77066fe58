"""Checks the records of a table: start times, constant conditions, known inputs, ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.data.cells import OTHER_UNIT, SMALLEST
from gbspec.data.columns import Quantity
from gbspec.data.gaps import check_gaps
from gbspec.data.plausibility import check_plausibility, check_times, interval
from gbspec.data.positive import check_positive
from gbspec.data.records import Records, Series
from gbspec.data.sheet import SHOWN, shown
from gbspec.diagnostics import Cell, Findings
from gbspec.frames import counted
from gbspec.ir import Model, Range, informative_at_start


def check(table: Records, model: Model, wanted: tuple[Quantity, ...], measured: bool, findings: Findings) -> None:
    """Reports all errors in the records; `measured`: whether a measurement is required."""
    _resolved(table, findings)
    if model.time.start is not None:
        _after_start(table, model.time.start, findings)
    check_times(table, model, findings)
    for quantity, cells in table.series.items():
        check_plausibility(table, model, quantity, cells, findings)
        if quantity.positive:
            check_positive(table, quantity, cells, findings)
        if quantity.counts:
            _whole(table, quantity, cells, findings)
        if quantity.role == "channel":
            _deviations(table, quantity, cells, findings)
            _one_limit(table, quantity, cells, findings)
        elif quantity.role == "input":
            _one_at_a_time(table, quantity, cells, findings)
            check_gaps(table, quantity, model.inputs[quantity.index], cells, findings)
    start = starts_of(table, model.time.start)
    for quantity in wanted:
        if quantity.role == "condition":
            default = model.conditions[quantity.index].default
            _constant(table, quantity, default, findings)
        elif quantity.role == "input" and quantity in table.series and model.inputs[quantity.index].default is None:
            _known_at_start(table, quantity, start, findings)
    if measured:
        given = any(state.initial.kind in ("expression", "steady") for state in model.states)
        fixed = model.time.start is not None
        known = np.full(len(start), -np.inf) if fixed else start if given else start + np.inf
        _measured(table, known, _informative(table, model), findings)


def _resolved(table: Records, findings: Findings) -> None:
    """Reports successive times whose difference is too small to compute a slope with."""
    if any(d.code == "GB731" for d in findings.errors):
        return  # all times may be too small, which was said
    step = np.diff(table.time)
    close = np.flatnonzero((table.group[1:] == table.group[:-1]) & (step > 0) & (step < SMALLEST)) + 1
    for i, notes in shown(close, "rows"):
        row = int(table.row[i])
        message = f"row {row} is only {table.time[i] - table.time[i - 1]:g} later than the row before"
        findings.error("GB731", message, Cell(table.path, row, table.time_column), help=OTHER_UNIT, notes=notes)


def first_times(table: Records) -> Array:
    """The time of each trajectory's first row, measured or not [trajectories]; NaN if it has none."""
    first = np.full(len(table.labels), np.nan)
    groups, index = np.unique(table.group, return_index=True)
    first[groups] = table.time[index]
    return first


def starts_of(table: Records, fixed: float | None) -> Array:
    """When each trajectory starts: as the table says, else as the model says, else at its first row."""
    usual = first_times(table) if fixed is None else np.full(len(table.labels), fixed)
    return usual if table.starts is None else np.where(np.isnan(table.starts), usual, table.starts)


def _after_start(table: Records, start: float, findings: Findings) -> None:
    early = np.flatnonzero(table.time < start)
    for i, notes in shown(early, "rows"):
        row = int(table.row[i])
        findings.error(
            "GB717",
            f"row {row} lies before the start: time {table.time[i]:g}, and the model starts at {start:g}",
            Cell(table.path, row, table.time_column),
            help="change `from` in the model's `time` statement, or remove the row",
            notes=notes,
        )


def _whole(table: Records, quantity: Quantity, cells: Series, findings: Findings) -> None:
    """Reports values that are no counts, and standard deviations of counts, which the noise already gives."""
    known = np.ones(len(cells.value), dtype=np.bool_) if cells.side is None else cells.side == 0
    bad = np.flatnonzero(known & ((cells.value < 0) | (cells.value != np.round(cells.value))))
    for i, notes in shown(bad, "cells"):
        row = int(cells.row[i])
        findings.error(
            "GB734",
            f"`{quantity.column}` is {cells.value[i]:g} in row {row}, and counts are whole numbers from 0",
            Cell(table.path, row, quantity.column),
            help="give what was counted, and put the volume or the share that was counted into the expression "
            f"(`observe {quantity.name} = 0.3*C`); for a concentration write `noise normal(a*sqrt(y))` with "
            "`learn a = 0.1 > 0`",
            notes=notes,
        )
    given = np.flatnonzero(np.isfinite(cells.sd))
    if len(given):
        row, column = int(cells.row[given[0]]), f"sd_{quantity.column}"
        findings.error(
            "GB734",
            f"`{column}` gives the standard deviation of a count, which its noise already gives",
            Cell(table.path, row, column),
            help="leave the column out; for counts that vary more than Poisson's write `noise negative_binomial(k)`",
        )


def _deviations(table: Records, quantity: Quantity, cells: Series, findings: Findings) -> None:
    tiny = np.flatnonzero((cells.sd > 0) & (cells.sd < SMALLEST))
    for i, notes in shown(tiny, "cells"):
        row = int(cells.row[i])
        message = f"the standard deviation of `{quantity.name}` is {cells.sd[i]:g} in row {row}"
        findings.error("GB731", message, Cell(table.path, row, f"sd_{quantity.column}"), help=OTHER_UNIT, notes=notes)
    bad = np.flatnonzero(cells.sd <= 0)
    for i, notes in shown(bad, "cells"):
        row = int(cells.row[i])
        findings.error(
            "GB723",
            f"the standard deviation of `{quantity.name}` is {cells.sd[i]:g} in row {row}",
            Cell(table.path, row, f"sd_{quantity.column}"),
            help="give a number above zero, or leave the cell empty where it is not known",
            notes=notes,
        )


def _one_limit(table: Records, quantity: Quantity, cells: Series, findings: Findings) -> None:
    """Reports limits beside other values of the same channel at the same time."""
    if cells.side is None:
        return
    several = np.bincount(cells.key, minlength=len(table.time)) > 1
    for i, notes in shown(np.flatnonzero((cells.side != 0) & several[cells.key]), "cells"):
        row = int(cells.row[i])
        findings.error(
            "GB765",
            f"`{quantity.name}` has a limit in row {row}, and another value at the same time",
            Cell(table.path, row, quantity.column),
            help="give replicates of which some are limits times that differ a little",
            notes=notes,
        )


def _one_at_a_time(table: Records, quantity: Quantity, cells: Series, findings: Findings) -> None:
    twice = np.flatnonzero((cells.key[1:] == cells.key[:-1]) & (cells.value[1:] != cells.value[:-1]))
    for i, notes in shown(twice, "times"):
        row = int(cells.row[i + 1])
        findings.error(
            "GB722",
            f"the input `{quantity.name}` has two values at time {table.time[cells.key[i]]:g}: "
            f"{cells.value[i]:g} in row {cells.row[i]} and {cells.value[i + 1]:g} in row {row}",
            Cell(table.path, row, quantity.column),
            help="an input has one value at each time; a jump is given by the value after it",
            notes=notes,
        )


def _constant(table: Records, quantity: Quantity, default: float | None, findings: Findings) -> None:
    """Reports conditions that change within a trajectory, or have no value and no default, and names the trajectories
    without one in a column that has a default: it is taken there."""
    cells = table.series.get(quantity)
    filled: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    if cells is not None:
        group = table.group[cells.key]
        filled, first = np.unique(group, return_index=True)
        expected = np.empty(len(table.labels))
        expected[filled] = cells.value[first]
        changed = np.flatnonzero(cells.value != expected[group])
        _, once = np.unique(group[changed], return_index=True)
        for i, notes in shown(changed[once], "trajectories"):
            row, label = int(cells.row[i]), table.labels[group[i]]
            before, now = (_shown(quantity, value) for value in (expected[group[i]], cells.value[i]))
            varies = f", or declare `input {quantity.name} held` if it does vary in time"
            findings.error(
                "GB719",
                f"the condition `{quantity.name}` changes within trajectory `{label}`: "
                f"from {before} to {now} in row {row}",
                Cell(table.path, row, quantity.column),
                help="begin a new trajectory there" + (varies if not quantity.categories else ""),
                notes=notes,
            )
    empty = np.setdiff1d(np.unique(table.group), filled)
    if cells is None and (quantity.required or default is not None):
        return  # a column that is missing altogether has been reported, or need not be there
    if not len(empty) or _unreadable(quantity, findings):
        return
    if default is not None:
        _assumed(table, quantity, default, empty, findings)
        return
    for g, notes in shown(empty, "trajectories"):
        row = int(table.row[np.searchsorted(table.group, g)])
        findings.error(
            "GB720",
            f"trajectory `{table.labels[g]}` has no value of the condition `{quantity.name}`",
            Cell(table.path, row, quantity.column),
            help="fill it in one row of the trajectory, or give the condition a default in the model",
            notes=notes,
        )


def _unreadable(quantity: Quantity, findings: Findings) -> bool:
    """Whether cells of a quantity were reported, so that they are not empty although they have no value."""
    places = [d.place for d in findings.errors if d.code in ("GB712", "GB713", "GB730", "GB731", "GB733")]
    return any(isinstance(place, Cell) and place.column in (quantity.column, "value") for place in places)


def _assumed(table: Records, quantity: Quantity, default: float, empty: NDArray[np.int64], findings: Findings) -> None:
    """Warns of the trajectories `empty` that have the default of a condition although the table has it."""
    of = len(np.unique(table.group))
    listed = ", ".join(f"`{table.labels[g]}`" for g in empty[:5]) + (", ..." if len(empty) > 5 else "")
    where = "all trajectories" if len(empty) == of else f"{len(empty)} of {of} trajectories ({listed})"
    findings.warning(
        "GB793",
        f"`{quantity.column}` is empty in {where}: its default, {_shown(quantity, default)}, is taken there",
        Cell(table.path, int(table.row[np.searchsorted(table.group, empty[0])]), quantity.column),
        help="fill it in where it is known, also where it is the default",
        subject=quantity.name,
    )


def _known_at_start(table: Records, quantity: Quantity, start: Array, findings: Findings) -> None:
    """Reports inputs without a value at the start of a trajectory."""
    if _unreadable(quantity, findings):
        return
    cells = table.series[quantity]
    first = np.full(len(table.labels), np.inf)
    np.minimum.at(first, table.group[cells.key], table.time[cells.key])
    late = [int(g) for g in np.unique(table.group) if first[g] > start[g]]
    for g, notes in shown(late, "trajectories"):
        at = int(np.searchsorted(table.group, g))
        row = int(table.row[at])
        known = "it has no value at all" if np.isinf(first[g]) else f"its first is at time {first[g]:g}"
        findings.error(
            "GB721",
            f"the input `{quantity.name}` has no value where trajectory `{table.labels[g]}` starts "
            f"(time {start[g]:g}); {known}",
            Cell(table.path, row, quantity.column),
            help="fill it in the first row"
            if table.time[at] <= start[g]
            else f"add a row at time {start[g]:g} with its value; the other cells may be empty",
            notes=notes,
        )


def _informative(table: Records, model: Model) -> Mask:
    """Whether a single measured time has information about the dynamics [trajectories]: rates or learned functions are
    measured, and more channels than there are unknown initial values."""
    cells = [(quantity, cells) for quantity, cells in table.series.items() if quantity.role == "channel"]
    tells, free = informative_at_start(model), sum(not state.initial.known for state in model.states)
    some, count = np.zeros(len(table.labels), dtype=bool), np.zeros(len(table.labels), dtype=np.int64)
    for quantity, measured in cells:
        groups = np.unique(table.group[measured.key])
        count[groups] += 1
        some[groups] |= tells[quantity.index]
    return some & (count > free)


def _measured(table: Records, known: Array, informative: Mask, findings: Findings) -> None:
    """Reports tables without measurements; warns of trajectories with fewer than two measured times, unless their one
    time comes after that of a `known` start [trajectories], as where a dose is given first, or is
    `informative` itself."""
    channels = {quantity: cells for quantity, cells in table.series.items() if quantity.role == "channel"}
    hit = np.zeros(len(table.time), dtype=bool)
    for cells in channels.values():
        hit[cells.key] = True
    if not hit.any():
        if not any(d.code in ("GB710", "GB712", "GB730") for d in findings.errors):
            findings.error(
                "GB726",
                "nothing is measured in this table: all cells of its channels are empty",
                Cell(table.path),
                help="each row has the channels that were measured at its time",
            )
        return
    if findings.failed:
        return  # other errors may be the reason
    count = np.bincount(table.group[hit], minlength=len(table.labels))
    present = np.unique(table.group)
    _point_out(table, [int(g) for g in present if count[g] == 0], "GB728", findings)
    last = np.full(len(table.labels), -np.inf)
    np.maximum.at(last, table.group[hit], table.time[hit])
    silent = [int(g) for g in present if count[g] == 1 and not (last[g] > known[g] or informative[g])]
    _point_out(table, silent, "GB727", findings)


def _point_out(table: Records, groups: list[int], code: str, findings: Findings) -> None:
    """One warning for all trajectories with no (GB728) or one (GB727) measured time."""
    if not groups:
        return
    names = ", ".join(f"`{table.labels[g]}`" for g in groups[:SHOWN])
    names += f" and {len(groups) - SHOWN:,} more" if len(groups) > SHOWN else ""
    some = "trajectories" if len(groups) > 1 else "trajectory"
    row = int(table.row[np.searchsorted(table.group, groups[0])])
    if code == "GB728":
        message = f"{some} {names}: nothing was measured; left out"
        advice = "remove the rows, or fill in what was measured"
    else:
        message = f"{some} {names}: measured at only one time, which contains no information about the dynamics"
        advice = "a trajectory needs two times, or a known start before the only one (`time t from 0`)"
    findings.warning(code, message, Cell(table.path, row, None), help=advice)


@dataclass(frozen=True)
class Beyond:
    """Values of a state far outside of its declared range: `count` of `known` ones, between `least` and `most`."""

    name: str
    bounds: Range
    count: int
    known: int
    least: float
    most: float

    @classmethod
    def of(cls, name: str, bounds: Range | None, column: Array) -> Beyond | None:
        """Those values that lie outside of a range by more than a tenth of it, if there are any: noise and small errors
        of a fit may leave it by less."""
        if bounds is None or not bounds.bounded:
            return None
        margin = 0.1 * (bounds.high - bounds.low)
        beyond = column[(column < bounds.low - margin) | (column > bounds.high + margin)]
        if not len(beyond):
            return None
        known = int(np.isfinite(column).sum())
        return cls(name, bounds, len(beyond), known, float(beyond.min()), float(beyond.max()))

    def __str__(self) -> str:
        verb = "lies" if self.count == 1 else "lie"
        return (
            f"`{self.name}`: {self.count} of {counted(self.known, 'value')} {verb} far outside of its range "
            f"{interval(self.bounds)}: {self._spread}"
        )

    @property
    def _spread(self) -> str:
        least, most = f"{self.least:.4g}", f"{self.most:.4g}"
        return f"from {least} to {most}" if least != most else least

    @property
    def brief(self) -> str:
        """The same in a list of several states."""
        return f"`{self.name}` ({self._spread}, {self.count} of {self.known} values; range {interval(self.bounds)})"


def far_outside(model: Model, values: Array) -> list[str]:
    """A sentence for each channel that is a state and has values [rows, channels] far outside of its declared range."""
    states = {j: channel.state for j, channel in enumerate(model.channels) if channel.state is not None}
    found = (Beyond.of(model.channels[j].name, model.states[i].range, values[:, j]) for j, i in states.items())
    return [str(one) for one in found if one is not None]


def states_beyond(model: Model, states: Array) -> list[Beyond]:
    """What is to be said of each state that has values [rows, states] far outside of its declared range."""
    found = (Beyond.of(state.name, state.range, column) for state, column in zip(model.states, states.T, strict=True))
    return [one for one in found if one is not None]


def said_of_ranges(found: Sequence[Beyond]) -> list[str]:
    """One sentence of all states with values far outside of their ranges; none if there are none."""
    if len(found) < 2:
        return [str(one) for one in found]
    listed = ", ".join(one.brief for one in found)
    return [f"values of {len(found)} states lie far outside of their ranges: {listed}"]


def _shown(quantity: Quantity, value: float) -> str:
    """A value of a condition, as the table has it."""
    return f"`{quantity.categories[int(value)]}`" if quantity.categories else f"{value:g}"
