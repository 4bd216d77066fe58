"""Predictions as a table: one row per row of the data, with intervals and the use of the row."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from gbspec.analysis import Forecast
from gbspec.data import FORMATS, PARQUET, SEPARATORS, TRAJECTORY, for_spreadsheets
from gbspec.diagnostics import Cell, Diagnostic, UserError
from gbspec.files import aside, writable, write_text


def target(path: str | Path) -> Path:
    """The path, if a table can be written there. Raises `UserError` (GB812 for the suffix, GB802, GB805)."""
    found = Path(path)
    if found.suffix.lower() not in (*SEPARATORS, *PARQUET):
        message = f"cannot write a table to `{path}`"
        raise UserError([Diagnostic("GB812", message, Cell(str(path)), help=f"name it as {FORMATS}")])
    return writable(found)


def frame(forecast: Forecast, time: str) -> pl.DataFrame:
    """Columns `trajectory`, the time, NAME, NAME_low and NAME_high of each variable, `used` and `outside`.

    `used` is `training`, `window` (the initial state was estimated from this row) or `predicted`; `outside` names the
    states and conditions that lie beyond the range in which the model was trained.
    """
    items = forecast.items
    columns: dict[str, pl.Series] = {
        TRAJECTORY: pl.Series([item.label for item in items for _ in item.times], dtype=pl.String),
        time: pl.Series(np.concatenate([np.zeros(0), *(item.times for item in items)]), dtype=pl.Float64),
    }
    for j, name in enumerate(forecast.variables):
        for suffix, which in (("", "mean"), ("_low", "low"), ("_high", "high")):
            values = np.concatenate([np.zeros(0), *(getattr(item, which)[:, j] for item in items)])
            columns[name + suffix] = pl.Series(values, dtype=pl.Float64).fill_nan(None)
    columns["used"] = pl.Series([use for item in items for use in item.used], dtype=pl.String)
    columns["outside"] = pl.Series([" ".join(names) for item in items for names in item.outside], dtype=pl.String)
    return pl.DataFrame(columns)


def write(path: str | Path, forecast: Forecast, time: str) -> None:
    """Writes the table in the format given by the path's suffix."""
    to = target(path)
    made = frame(forecast, time)
    if to.suffix.lower() in PARQUET:
        with aside(to) as temporary:
            made.write_parquet(temporary)
    else:
        safe = made.with_columns(pl.Series(TRAJECTORY, map(for_spreadsheets, made[TRAJECTORY]), dtype=pl.String))
        write_text(to, safe.write_csv(separator=SEPARATORS[to.suffix.lower()]))
