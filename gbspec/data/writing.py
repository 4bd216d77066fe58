"""Writes trajectories to a table of the wide layout, with numbers in full precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from gbspec.arrays import Array
from gbspec.data.columns import TRAJECTORY, quantities
from gbspec.data.names import for_spreadsheets
from gbspec.data.sheet import FORMATS, PARQUET, SEPARATORS
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.diagnostics import Cell, Diagnostic, UserError
from gbspec.files import aside
from gbspec.ir import Model


def write(path: str | Path, trajectories: Trajectories, model: Model) -> None:
    """Writes the table, so that reading it gives the same trajectories (replicates as their averages).

    Columns: `trajectory`, the time, channels, `sd_…` if there is any, inputs (filled where they are given),
    conditions, doses. The suffix of `path` selects CSV, TSV or Parquet. Raises UserError if it cannot
    be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SEPARATORS and suffix not in PARQUET:
        raise UserError(
            [Diagnostic("GB812", f"cannot write a table to `{path}`", Cell(str(path)), help=f"name it as {FORMATS}")]
        )
    frame = table(trajectories, model)
    safe = frame.with_columns(pl.Series(TRAJECTORY, map(for_spreadsheets, frame[TRAJECTORY]), dtype=pl.String))
    try:
        with aside(path) as temporary:
            if suffix in PARQUET:
                safe.write_parquet(temporary)
            else:
                temporary.write_text(safe.write_csv(separator=SEPARATORS[suffix]), encoding="utf-8")
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError([Diagnostic("GB701", f"cannot write `{path}`: {reason}", Cell(str(path)))]) from error


def table(trajectories: Trajectories, model: Model) -> pl.DataFrame:
    """The trajectories as a data frame of the wide layout; null where nothing was measured."""
    blocks = [_block(item, model) for item in trajectories.items]
    names = [model.time.name, *(q.column for q in quantities(model))]
    width = len(names)
    stacked = np.concatenate(blocks) if blocks else np.zeros((0, width))
    labels = [item.label for item, block in zip(trajectories.items, blocks, strict=True) for _ in range(len(block))]
    columns = {TRAJECTORY: pl.Series(labels, dtype=pl.String)}
    for name, values in zip(names, stacked.T, strict=True):
        if name.startswith("sd_") and np.isnan(values).all():
            continue
        columns[name] = pl.Series(values, dtype=pl.Float64).fill_nan(None)
    return pl.DataFrame(columns)


def _block(item: Trajectory, model: Model) -> Array:
    """One trajectory's rows [R, 1 + quantities]; NaN where a cell is empty."""
    moments = [item.times, *(s.times for s in item.inputs), *(d.times for d in item.doses)]
    first = min((float(times[0]) for times in moments if len(times)), default=np.inf)
    if model.time.start is None and item.start < first:
        moments.append(np.array([item.start]))
    times = np.unique(np.concatenate(moments))
    columns = [times]
    at = np.searchsorted(times, item.times)
    for quantity in quantities(model):
        cells = np.full(len(times), np.nan)
        match quantity.role:
            case "channel":
                cells[at] = item.values[:, quantity.index]
            case "sd":
                cells[at] = item.sd[:, quantity.index]
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
