"""Tables in memory as sheets: data frames of polars and pandas, tables of pyarrow, and dictionaries of arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import polars as pl

from gbspec.arrays import Array
from gbspec.data.names import cell_name
from gbspec.data.sheet import Sheet, unique
from gbspec.diagnostics import Cell, Findings

Frame: TypeAlias = Any
"""A data frame of polars, pandas or pyarrow, or a mapping of names to columns; pandas is not imported for this."""
NAME = "<data>"
"""How messages name a table in memory."""


def is_frame(data: object) -> bool:
    """Whether an object is a table in memory."""
    return isinstance(data, Mapping | pl.DataFrame | pl.LazyFrame) or (
        hasattr(data, "__getitem__") and (hasattr(data, "columns") or hasattr(data, "column_names"))
    )


def sheet_of(data: Frame, findings: Findings) -> Sheet | None:
    """The columns of a table in memory, its rows counted from 0; None (and at least one error) if it has none."""
    frame: Frame = data.collect() if isinstance(data, pl.LazyFrame) else data
    given: Sequence[object] = list(frame) if isinstance(frame, Mapping) else _column_names(frame)
    names = [cell_name(str(name)) for name in given]
    before = len(findings.errors)
    unique(NAME, names, findings)
    if len(findings.errors) > before:
        return None
    columns = {name: _series(frame[key]) for name, key in zip(names, given, strict=True)}
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        (first, count), *_ = lengths.items()
        other = next(name for name, length in lengths.items() if length != count)
        message = f"column `{other}` has {lengths[other]} values, column `{first}` has {count}"
        findings.error("GB708", message, Cell(NAME, None, other), help="each row needs a cell in every column")
        return None
    if not columns or not next(iter(lengths.values())):
        findings.error("GB704", "the table is empty", Cell(NAME), help="each row is one time")
        return None
    rows = np.arange(next(iter(lengths.values())), dtype=np.int64)
    return Sheet(NAME, columns, rows, "", header=None)


def _column_names(frame: Frame) -> list[object]:
    return list(frame.column_names if hasattr(frame, "column_names") else frame.columns)


def _series(column: Any) -> pl.Series:
    """A column of any kind; what is missing in a column of objects is null."""
    if isinstance(column, pl.Series):
        return column
    if hasattr(column, "detach"):  # a tensor
        column = column.detach().cpu()
    values = np.asarray(column.to_numpy() if hasattr(column, "to_numpy") else column)
    if values.ndim != 1:
        values = values.reshape(len(values), -1)[:, 0] if values.ndim and values.size == len(values) else values.ravel()
    if values.dtype.kind in "fiub" or values.dtype.kind == "M":
        return pl.Series(values.astype(np.float64) if values.dtype.kind == "f" else values)
    # pandas.NA first: a comparison with it has no truth value
    cells = [None if cell is None or str(cell) == "<NA>" or cell != cell else cell for cell in values.tolist()]
    if all(cell is None or (isinstance(cell, int | float) and not isinstance(cell, bool)) for cell in cells):
        return pl.Series([None if cell is None else float(cell) for cell in cells], dtype=pl.Float64)
    return pl.Series([None if cell is None else str(cell) for cell in cells], dtype=pl.String)


def frame_columns(data: Frame) -> dict[str, Array]:
    """The columns of numbers of a table in memory by name. Raises `UserError` if it is empty or not rectangular."""
    findings = Findings()
    sheet = sheet_of(data, findings)
    findings.raise_if_failed()
    columns = {} if sheet is None else sheet.columns
    return {name: c.cast(pl.Float64).to_numpy() for name, c in columns.items() if c.dtype.is_numeric()}
