"""Inputs that are recorded in row after row, but for a gap, in which a value is taken that nobody has measured."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.data.columns import Quantity
from gbspec.data.records import Index, Records, Series
from gbspec.diagnostics import Cell, Findings
from gbspec.ir import Input

LONG = 5
"""Empty cells in a row that are a gap, if they also last for so many usual intervals."""
RECORDED, FILLED = 0.5, 0.95
"""An input is recorded in every row where at least the first share of a trajectory's cells is filled, and the second
of those that are not empty together with a neighbour: one that is filled where it changes, or at times of its own, has
empty cells between."""
FEWEST = 10
"""A trajectory with fewer filled cells shows nothing of how the input is recorded."""


@dataclass(frozen=True)
class _Gap:
    """Empty cells of an input from the key `first` to the key `last`; `before` is the value of the cell before them,
    and `trailing` says whether none comes after them."""

    first: int
    last: int
    before: float
    trailing: bool


def check_gaps(table: Records, quantity: Quantity, given: Input, cells: Series, findings: Findings) -> None:
    """Warns of gaps in an input that is otherwise recorded in every row (GB792), once for each input."""
    values = np.full(len(table.time), np.nan)
    values[cells.key] = cells.value
    found = [gap for keys in _trajectories(table) for gap in _gaps(table, keys, values[keys])]
    if not found:
        return
    longest = max(found, key=lambda gap: float(table.time[gap.last] - table.time[gap.first]))
    start, end = table.time[longest.first], table.time[longest.last]
    count = longest.last - longest.first + 1
    held = given.interpolation == "held" or longest.trailing
    taken = f"its last value before, {longest.before:g}, is held" if held else "it is interpolated"
    others = len(found) - 1
    more = "" if not others else " (there is one more gap)" if others == 1 else f" (there are {others} more gaps)"
    row = int(table.row[longest.first])
    findings.warning(
        "GB792",
        f"`{quantity.column}` has no value at {count:,} times, from {start:g} to {end:g} (from row {row} on), and has "
        f"one at most others of this trajectory: in this gap {taken}{more}",
        Cell(table.path, row, quantity.column),
        help="if it was not recorded there, fill in what it may have been, or let the trajectory end before this gap "
        "and another one begin after it",
        subject=quantity.name,
    )


def _trajectories(table: Records) -> Iterator[Index]:
    """The keys of each trajectory."""
    ends = np.flatnonzero(np.diff(table.group)) + 1
    yield from np.split(np.arange(len(table.group), dtype=np.int64), ends)


def _gaps(table: Records, keys: Index, values: Array) -> list[_Gap]:
    """The gaps of one trajectory, of these keys and values (NaN: an empty cell), in which an input is recorded in every
    other row."""
    places, time = np.flatnonzero(np.isfinite(values)), table.time[keys]
    if len(places) < max(FEWEST, RECORDED * len(keys)):
        return []
    usual = float(np.median(np.diff(time)))
    found, inside = [], 0
    for before, after in zip(places, np.append(places[1:], len(keys)), strict=True):
        count = int(after - before) - 1
        if count >= LONG and time[after - 1] - time[before] >= LONG * usual:
            ends = int(keys[before + 1]), int(keys[after - 1])
            found.append(_Gap(*ends, float(values[before]), after == len(keys)))
        inside += count if count > 1 else 0
    outside = len(keys) - int(places[0]) - inside
    return found if len(places) >= FILLED * outside else []
