"""Writes trajectories to a table of the wide layout, with numbers in full precision."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from gbspec.data.columns import TRAJECTORY, form_of
from gbspec.data.names import for_spreadsheets
from gbspec.data.sheet import FORMATS, PARQUET, SEPARATORS
from gbspec.data.trajectories import Trajectories, frame_of
from gbspec.diagnostics import Cell, Diagnostic, UserError
from gbspec.files import aside
from gbspec.given import WRITTEN, require_path
from gbspec.ir import Model


def write(path: str | Path, trajectories: Trajectories, model: Model) -> None:
    """Writes the table, so that reading it gives the same trajectories (replicates as their averages).

    Columns: `trajectory`, the time, channels, `sd_…` if there is any, inputs (filled where they are given),
    conditions, doses. The suffix of `path` selects CSV, TSV or Parquet. Raises UserError if it cannot
    be written.
    """
    require_path(path, WRITTEN)
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SEPARATORS and suffix not in PARQUET:
        raise UserError(
            [Diagnostic("GB812", f"cannot write a table to `{path}`", Cell(str(path)), help=f"name it as {FORMATS}")]
        )
    form = form_of(model)
    frame = frame_of(trajectories, form)
    texts = [TRAJECTORY, *(quantity.column for quantity in form.quantities if quantity.categories)]
    safe = frame.with_columns(pl.col(texts).map_elements(for_spreadsheets, return_dtype=pl.String))
    try:
        with aside(path) as temporary:
            if suffix in PARQUET:
                safe.write_parquet(temporary)
            else:
                temporary.write_text(safe.write_csv(separator=SEPARATORS[suffix]), encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError([Diagnostic("GB701", f"cannot write `{path}`: {reason}", Cell(str(path)))]) from error
