"""Reads tables of measurements of either layout to trajectories.

`read` has four stages, each in its own module: `sheet` (the file's cells), `columns` (their quantities), `records`
(numbers by trajectory and time), `checks` (their validity); then the records are split into trajectories here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.data.checks import check, starts_of
from gbspec.data.columns import Quantity, form_of, quantities, recognise
from gbspec.data.formats import Format
from gbspec.data.keeping import content_digest
from gbspec.data.memory import Frame, sheet_of
from gbspec.data.nonmem import is_nonmem, nonmem_records
from gbspec.data.positive import check_zeros
from gbspec.data.records import Records, records
from gbspec.data.regimens import Given, regimens, with_infusions
from gbspec.data.sheet import Sheet, read_sheet
from gbspec.data.subjects import warn_of_subjects
from gbspec.data.trajectories import Limits, Signal, Trajectories, Trajectory
from gbspec.data.writing import write
from gbspec.diagnostics import Findings, UserError
from gbspec.ir import Model, logarithmic

__all__ = ["read", "read_frame", "write"]

AUTO = Format()
"""The form is recognised by the columns."""


def read(
    path: str | Path, model: Model, findings: Findings, require_channels: bool = True, form: Format = AUTO
) -> Trajectories:
    """The table at `path` (CSV, TSV or Parquet; wide or long layout, or NONMEM's form) as trajectories for `model`.

    Cells that are empty, or are NA, NaN, null, none, `-` or `.`, mean *not measured*. With `require_channels` False (a
    table to predict on), columns of channels may be missing and a trajectory's `times` hold every row, measured or not.

    Warnings go into `findings`. Raises UserError with all diagnostics if the table has errors.
    """
    return _read(read_sheet(path, findings), model, findings, require_channels, form)


def read_frame(
    data: Frame, model: Model, findings: Findings, require_channels: bool = True, form: Format = AUTO
) -> Trajectories:
    """A table in memory as trajectories, like `read`; they are identified by their content.

    `data` is a data frame of polars, pandas or pyarrow, or a mapping of names to columns (arrays, lists, tensors).
    """
    found = _read(sheet_of(data, findings), model, findings, require_channels, form)
    return replace(found, path="", sha256=content_digest(found))


def _read(sheet: Sheet | None, model: Model, findings: Findings, require_channels: bool, form: Format) -> Trajectories:
    if sheet is None:
        raise UserError(tuple(findings))
    wanted = quantities(model, require_channels)
    table, kind = _recorded(sheet, model, wanted, form, findings)
    source = sheet.path, sheet.sha256, len(sheet.rows)
    del sheet  # its texts are not needed any more, and a table may take most of the memory
    check(table, model, wanted, require_channels, findings)
    findings.raise_if_failed()
    conditions, known = _conditions(table, model)
    items = _cut(table, model, require_channels, conditions, known, regimens(table, model, conditions, findings))
    check_zeros(table, model, items, findings)
    findings.raise_if_failed()
    channels = tuple(channel.name for channel in model.channels)
    return Trajectories(items, channels, *source, kind, form_of(model))


def _recorded(
    sheet: Sheet, model: Model, wanted: tuple[Quantity, ...], form: Format, findings: Findings
) -> tuple[Records, dict[str, str]]:
    """The records of a sheet of any form, and what is remembered of the form."""
    if form.kind == "nonmem" or (form.kind == "auto" and is_nonmem(sheet, model)):
        form.check(model)
        table = nonmem_records(sheet, model, wanted, form, findings)
        if table is None:
            raise UserError(tuple(findings))
        return table, {"layout": "nonmem", "format": form.text if form.kind == "nonmem" else "nonmem"}
    layout = recognise(sheet, model, wanted, findings)
    if layout is None:
        raise UserError(tuple(findings))
    warn_of_subjects(sheet, layout.trajectory, model, findings)
    return records(sheet, layout, findings), {"layout": "long" if layout.long else "wide"}


def _cut(
    table: Records, model: Model, measured_only: bool, conditions: Array, known: Mask, given: Sequence[Given]
) -> tuple[Trajectory, ...]:
    """The trajectories of valid records, in the order of their first rows; `known` are the `conditions` that the table
    has."""
    values, counts, sd, scatter, limits = _measurements(table, logarithmic(model))
    starts = starts_of(table, model.time.start)
    edges = np.searchsorted(table.group, np.arange(len(table.labels) + 1))
    inputs = [_pieces(table, i) for i in range(len(model.inputs))]
    hit: Mask = np.ones(len(table.time), dtype=bool)
    if measured_only:
        hit = np.any(counts > 0, axis=1)
    items: list[Trajectory] = []
    for g, label in enumerate(table.labels):
        rows: slice | NDArray[np.int64] = slice(edges[g], edges[g + 1])
        if not hit[rows].all():
            rows = np.flatnonzero(hit[rows]) + edges[g]
        times = table.time[rows]
        if not len(times):
            continue
        run_in = given[g].run_in
        start = float(starts[g]) if run_in is None else given[g].start - run_in.duration
        items.append(
            Trajectory(
                label=label,
                start=start,
                times=times,
                values=values[rows],
                counts=counts[rows],
                sd=sd[rows],
                condition=conditions[g],
                inputs=with_infusions(
                    model,
                    given[g],
                    [_signal(p[g], start, one.default) for p, one in zip(inputs, model.inputs, strict=True)],
                    start,
                    times,
                ),
                doses=given[g].doses,
                run_in=run_in,
                limits=limits.rows(rows) if limits is not None and limits.side[rows].any() else None,
                scatter=scatter[rows] if (counts[rows] > 1).any() else None,
                assumed=tuple(int(i) for i in np.flatnonzero(~known[g])),
            )
        )
    return tuple(items)


def _measurements(table: Records, logs: Mask) -> tuple[Array, Array, Array, Array, Limits | None]:
    """Values, numbers of measurements, standard deviations and scatter at each key, [keys, channels]; replicates
    averaged, on the scale on which they are fitted: logarithms in the channels `logs` [channels], whose average is the
    geometric one; and limits, which have no value (None without any).

    The standard deviation of an average of n is sqrt(sum of squares)/n; it is given if all of them have one.
    """
    size, channels = len(table.time), len(logs)
    values, counts = np.full((size, channels), np.nan), np.zeros((size, channels))
    sd, scatter = np.full((size, channels), np.nan), np.zeros((size, channels))
    limits: Limits | None = None
    if any(cells.side is not None for cells in table.series.values()):
        limits = Limits(np.full((size, channels), np.nan), np.zeros((size, channels), dtype=np.int8))
    for quantity, cells in table.series.items():
        if quantity.role != "channel":
            continue
        c = quantity.index
        counts[:, c] = np.bincount(cells.key, minlength=size)
        several = counts[:, c] > 1
        values[cells.key, c] = cells.value
        sd[cells.key, c] = cells.sd
        if several.any():
            found = _averages(cells.key, cells.value, cells.sd, size, bool(logs[c]))
            for whole, part in zip((values, sd, scatter), found, strict=True):
                whole[several, c] = part[several]
        if cells.side is not None and limits is not None:
            censored = cells.side != 0
            limits.side[cells.key, c] = cells.side
            limits.value[cells.key[censored], c] = cells.value[censored]
            values[cells.key[censored], c] = np.nan
    return values, counts, sd, scatter, limits


def _averages(key: NDArray[np.int64], value: Array, sd: Array, size: int, logs: bool) -> tuple[Array, Array, Array]:
    """The averages of the values [m] of each key [size], their standard deviations, and the sums of squared deviations
    from them; of logarithms all three in the unit of the values, in which small deviations are those of logarithms
    times the average. Zeros of a state that is absent have no logarithm, and are averaged as they are."""
    size_of = np.where(value > 0, value, 1.0) if logs else np.ones(len(value))
    fitted = np.log(size_of) if logs else value
    with np.errstate(invalid="ignore"):  # keys without a value
        count = np.bincount(key, minlength=size)
        mean = np.bincount(key, weights=fitted, minlength=size) / count
        variance = np.bincount(key, weights=(sd / size_of) ** 2, minlength=size)
        off = np.bincount(key, weights=(fitted - mean[key]) ** 2, minlength=size)
        unit = np.exp(mean) if logs else np.ones(size)
        average = np.where(np.bincount(key, weights=value, minlength=size) > 0, unit, 0.0) if logs else mean
        return average, unit * np.sqrt(variance) / count, unit**2 * off


def _conditions(table: Records, model: Model) -> tuple[Array, Mask]:
    """The conditions of each trajectory, [trajectories, conditions], and which of them the table has."""
    default = [np.nan if item.default is None else item.default for item in model.conditions]
    conditions = np.tile(np.array(default, dtype=np.float64), (len(table.labels), 1))
    known = np.zeros(conditions.shape, dtype=bool)
    for quantity, cells in table.series.items():
        if quantity.role == "condition":
            place = table.group[cells.key], quantity.index
            conditions[place], known[place] = cells.value, True
    return conditions, known


def _pieces(table: Records, index: int) -> list[tuple[Array, Array]]:
    """The filled cells of an input by trajectory: times and values, in the order of time."""
    number = len(table.labels)
    found = [(q, cells) for q, cells in table.series.items() if q.role == "input" and q.index == index]
    if not found:
        return [(np.zeros(0), np.zeros(0))] * number
    _, cells = found[0]
    key, value = _once(cells.key, cells.value)
    edges = np.searchsorted(table.group[key], np.arange(number + 1))
    time = table.time[key]
    return [(time[edges[g] : edges[g + 1]], value[edges[g] : edges[g + 1]]) for g in range(number)]


def _once(key: NDArray[np.int64], value: Array) -> tuple[NDArray[np.int64], Array]:
    """The entries without repetitions at the same time."""
    keys, first = np.unique(key, return_index=True)
    return keys, value[first]


def _signal(piece: tuple[Array, Array], start: float, default: float | None) -> Signal:
    """An input's signal; without a value at the start, the default holds from there."""
    times, values = piece
    if default is not None and (not len(times) or times[0] > start):
        times, values = np.concatenate([[start], times]), np.concatenate([[default], values])
    return Signal(times, values)
