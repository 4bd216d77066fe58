"""Predictions as a table: one row per row of the data, with intervals and the use of the row."""

from __future__ import annotations

from pathlib import Path

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


def write(path: str | Path, forecast: Forecast) -> None:
    """Writes the table in the format given by the path's suffix."""
    to = target(path)
    made = forecast.to_frame()
    if to.suffix.lower() in PARQUET:
        with aside(to) as temporary:
            made.write_parquet(temporary)
    else:
        safe = made.with_columns(pl.Series(TRAJECTORY, map(for_spreadsheets, made[TRAJECTORY]), dtype=pl.String))
        write_text(to, safe.write_csv(separator=SEPARATORS[to.suffix.lower()]))
