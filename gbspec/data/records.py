"""A sheet of either layout as records: the keys (trajectory and time) and, for each quantity, its filled cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.data.cells import categories, coded, labels, numbered, numbers
from gbspec.data.columns import TRAJECTORY, Layout, Quantity, describe, labelling
from gbspec.data.limits import Sides, measured, sides
from gbspec.data.names import cell_name, similar
from gbspec.data.sheet import SHOWN, Sheet, shown
from gbspec.diagnostics import Cell, Findings

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Series:
    """The filled cells of one quantity: `key` indexes the keys, `row` is the table's, `sd` NaN where not given [n].

    `side` [n]: -1 and 1 where the value is a limit that the measured value lies below or above; None: nowhere.
    """

    key: Index
    value: Array
    row: Index
    sd: Array
    side: Sides | None = None

    def where(self, chosen: Mask) -> Series:
        """The chosen cells; without a copy if these are all."""
        if chosen.all():
            return self
        side = None if self.side is None else self.side[chosen]
        return Series(self.key[chosen], self.value[chosen], self.row[chosen], self.sd[chosen], side)


@dataclass(frozen=True)
class Records:
    """The content of a table, independent of its layout.

    Keys are sorted by trajectory (in the order of first rows) and time: `group` [K] indexes `labels`, `time` [K], and
    `row` [K] is the first row of a key. `series` has the filled cells of each quantity that occurs. `starts`
    [trajectories]: when they start, where the table itself says it (else NaN; None: nowhere).
    """

    path: str
    labels: list[str]
    group: Index
    time: Array
    row: Index
    series: dict[Quantity, Series]
    time_column: str
    starts: Array | None = None


def records(sheet: Sheet, layout: Layout, findings: Findings) -> Records:
    """Reads the cells and reports all invalid ones; rows without a usable time are left out (and reported)."""
    time = numbers(sheet, layout.time, findings)
    if layout.trajectory is None:
        names, group = ["1"], np.zeros(len(time), dtype=np.int64)
    else:
        names, group = labels(sheet, layout.trajectory, findings)
    _times_given(sheet, layout.time, time, findings)
    if layout.long:
        return _long(sheet, layout, names, group, time, findings)
    return _wide(sheet, layout, names, group, time, findings)


def _times_given(sheet: Sheet, column: str, time: Array, findings: Findings) -> None:
    """Reports rows without a time, except those whose cell was already reported (a time that is not a number), or
    whose column was."""
    reported = [d.place.row or 0 for d in findings.errors if isinstance(d.place, Cell) and d.place.column == column]
    if len(reported) >= SHOWN or 0 in reported:
        return  # others look like empty ones: only some invalid cells were shown, or the column has no numbers
    bad = np.flatnonzero(np.isnan(time) & ~np.isin(sheet.rows, reported))
    for i, notes in shown(bad, "rows"):
        row = int(sheet.rows[i])
        findings.error(
            "GB714",
            f"row {row} has no time",
            Cell(sheet.path, row, column),
            help=f"fill `{column}` in every row",
            notes=notes,
        )


# ---------------------------------------------------------------------------------------------------- wide layout


def _order(group: Index, time: Array) -> Index | slice:
    """The rows that have a time, by trajectory; all of them, without a copy, where a table is in this order."""
    there = ~np.isnan(time)
    if there.all() and not (group[1:] < group[:-1]).any():
        return slice(None)
    keep = np.flatnonzero(there)
    return keep[np.argsort(group[keep], kind="stable")]


def _wide(sheet: Sheet, layout: Layout, names: list[str], group: Index, time: Array, findings: Findings) -> Records:
    """Records of the wide layout: one row per key, one column per quantity."""
    order = _order(group, time)
    group, time, row = group[order], time[order], sheet.rows[order]
    _increasing(sheet.path, layout.time, names, group, time, row, findings, _unnamed(sheet, layout))
    cells: dict[Quantity, Array] = {}
    side: dict[int, Sides] = {}
    for quantity in layout.columns:
        if quantity.role == "limit":
            side[quantity.index] = side.get(quantity.index, 0) + sides(sheet, quantity.column, findings)[order]
        elif quantity.role == "channel":
            values, limits = measured(sheet, quantity.column, findings)
            cells[quantity] = values[order]
            side[quantity.index] = limits[order] + side.get(quantity.index, 0)
        elif quantity.categories:
            cells[quantity] = categories(sheet, quantity.column, quantity.categories, findings)[order]
        elif quantity.labels:
            cells[quantity] = numbered(sheet, quantity.column, findings)[order]
        else:
            cells[quantity] = numbers(sheet, quantity.column, findings)[order]
    sds = {quantity.index: values for quantity, values in cells.items() if quantity.role == "sd"}
    series: dict[Quantity, Series] = {}
    everywhere = np.arange(len(time), dtype=np.int64)
    for quantity, values in cells.items():
        if quantity.role == "sd":
            continue
        sd = sds.get(quantity.index) if quantity.role == "channel" else None
        some = quantity.role == "channel" and side[quantity.index].any()
        sd = np.broadcast_to(np.nan, len(values)) if sd is None else sd
        given = Series(everywhere, values, row, sd, side[quantity.index] if some else None)
        series[quantity] = given.where(~np.isnan(values))
    return Records(sheet.path, names, group, time, row, series, layout.time)


def _increasing(
    path: str,
    column: str,
    names: list[str],
    group: Index,
    time: Array,
    row: Index,
    findings: Findings,
    unnamed: str,
) -> None:
    """Reports times that decrease within a trajectory (GB715) or occur twice (GB716).

    `unnamed` is the remedy where no column tells trajectories apart, which is told once.
    """
    same = group[1:] == group[:-1]
    for code, bad in (
        ("GB716", np.flatnonzero(same & (time[1:] == time[:-1]))),
        ("GB715", np.flatnonzero(same & (time[1:] < time[:-1]))),
    ):
        most = 1 if code == "GB716" else SHOWN  # replicates occur everywhere, for one reason
        for i, notes in shown(bad, "rows", most):
            here, before = float(time[i + 1]), float(time[i])
            where = f"in trajectory `{names[group[i]]}`" if len(names) > 1 else "in the table"
            twice = code == "GB716"
            findings.error(
                code,
                f"time {here:g} occurs twice {where}: in row {row[i]} and in row {row[i + 1]}"
                if twice
                else f"time goes back {where}: from {before:g} in row {row[i]} to {here:g} in row {row[i + 1]}",
                Cell(path, int(row[i + 1]), column),
                help="put both into one row; for replicates use the long layout (trajectory, t, name, value)"
                if twice
                else unnamed or "sort the rows by time, or begin a new trajectory there",
                notes=notes,
            )
            unnamed = "" if code == "GB715" else unnamed


def _unnamed(sheet: Sheet, layout: Layout) -> str:
    """The remedy for a time that goes back in a table without a column of trajectories; empty if it has one."""
    if layout.trajectory is not None:
        return ""
    read = {quantity.column for quantity in layout.columns} | {layout.time}
    others = [name for name in sheet.columns if name not in read]
    like = next(filter(labelling, others), None)
    remedy = f"rename `{like}`, if it is one" if like else "add one with a label for each experiment"
    return f"there is no column `{TRAJECTORY}`, so that all rows are one experiment: {remedy}, or sort the rows by time"


# ---------------------------------------------------------------------------------------------------- long layout


def _long(sheet: Sheet, layout: Layout, names: list[str], group: Index, time: Array, findings: Findings) -> Records:
    """Records of the long layout: one row per measurement of `name`, in any order; equal times are replicates."""
    worded = [quantity for quantity in layout.columns if quantity.categories or quantity.labels]
    value, side = _in_numbers(sheet, worded, findings) if worded else measured(sheet, "value", findings)
    sd = numbers(sheet, "sd", findings) if "sd" in sheet.columns else np.full(len(value), np.nan)
    kinds, kind = coded(_names(sheet))
    good = ~np.isnan(time)
    order = np.flatnonzero(good)[np.lexsort((sheet.rows[good], time[good], group[good]))]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (group[order][1:] != group[order][:-1]) | (time[order][1:] != time[order][:-1])
    key_of = np.full(len(time), -1, dtype=np.int64)
    key_of[order] = np.cumsum(new) - 1
    first = order[new]
    by_name = {quantity.column: quantity for quantity in layout.columns if quantity.role not in ("sd", "limit")}
    series: dict[Quantity, Series] = {}
    for index, name in enumerate(kinds):
        here = np.flatnonzero((kind == index) & good & ~np.isnan(value))
        quantity = by_name.get(name)
        if quantity is None:
            row = int(sheet.rows[np.flatnonzero(kind == index)[0]])
            _unknown_name(sheet, name, row, by_name, findings, layout.remedies.get(name, ""))
            continue
        here = here[np.argsort(key_of[here], kind="stable")]
        given = side[here] if side[here].any() else None
        _no_limits(sheet, quantity, here[side[here] != 0], findings)
        series[quantity] = Series(key_of[here], value[here], sheet.rows[here], sd[here], given)
    unread = [name for name in kinds if name not in by_name]
    for quantity in layout.columns:
        if quantity.lacks(kinds):
            _no_rows(sheet, quantity, similar(quantity.column, unread), findings)
    return Records(sheet.path, names, group[first], time[first], sheet.rows[first], series, layout.time)


def _in_numbers(sheet: Sheet, worded: Sequence[Quantity], findings: Findings) -> tuple[Array, Sides]:
    """The column `value` where the cells of some names are texts."""
    names, series = _names(sheet), sheet.columns["value"]
    found = np.full(len(series), np.nan)
    for quantity in worded:
        rows = (names == quantity.column).to_numpy()
        if quantity.categories:
            values = categories(sheet, "value", quantity.categories, findings, rows)
        else:
            values = numbered(sheet, "value", findings)
        found = np.where(rows, values, found)
    others = pl.Series("value", ~names.is_in([quantity.column for quantity in worded]).to_numpy())
    plain = pl.DataFrame({"value": series}).select(pl.when(others).then(pl.col("value"))).to_series()
    value, side = measured(replace(sheet, columns={**sheet.columns, "value": plain}), "value", findings)
    return np.where(np.isnan(found), value, found), side


def _no_limits(sheet: Sheet, quantity: Quantity, here: Index, findings: Findings) -> None:
    """Reports limits of what is no channel."""
    for i, notes in shown(here if quantity.role != "channel" else here[:0], "cells"):
        row = int(sheet.rows[i])
        message = f"row {row} gives a limit for {describe(quantity)}"
        findings.error("GB712", message, Cell(sheet.path, row, "value"), help="only channels have limits", notes=notes)


def _names(sheet: Sheet) -> pl.Series:
    """The column `name`, normalised like the names of columns."""
    texts = sheet.columns["name"].cast(pl.String).fill_null("").str.strip_chars()
    different = {text: cell_name(text) for text in texts.unique()}
    if all(text == name for text, name in different.items()):
        return texts
    return texts.replace_strict(list(different), list(different.values()), return_dtype=pl.String)


def _unknown_name(
    sheet: Sheet, name: str, row: int, known: dict[str, Quantity], findings: Findings, remedy: str
) -> None:
    meant = similar(name, known)
    findings.warning(
        "GB711",
        f"rows named `{name}` are not used: the model reads nothing of that name",
        Cell(sheet.path, row, "name"),
        help=remedy or (f"is `{meant}` meant?" if meant else ""),
        subject=name,
    )


def _no_rows(sheet: Sheet, quantity: Quantity, meant: str | None, findings: Findings) -> None:
    findings.error(
        "GB710",
        f"no row is named `{quantity.column}` for {describe(quantity)}",
        Cell(sheet.path, None, "name"),
        help=f"are the rows named `{meant}` meant?"
        if meant
        else "conditions and inputs have separate rows in the long layout: their name, and a value at a time",
    )


def kept(table: Records, keep: Mask) -> Records:
    """The records of the keys selected by a mask."""
    position = np.cumsum(keep) - 1
    series = {}
    for quantity, cells in table.series.items():
        chosen = cells.where(keep[cells.key])
        series[quantity] = replace(chosen, key=position[chosen.key])
    return replace(table, group=table.group[keep], time=table.time[keep], row=table.row[keep], series=series)
