"""Errors of predictions some rows ahead that are mostly those of one measurement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.validation.metrics import channel_errors
from gbspec.arrays import Array
from gbspec.ir import OF_COUNTS, OF_LOGARITHMS, on_error_scales

if TYPE_CHECKING:
    from gbspec.data import Trajectories
    from gbspec.runs import Run

MOST, ENOUGH = 0.5, 8
"""A row is told that has more than this part of a channel's sum of squares, of at least so many values."""
WIDE = 3.0
"""The standard deviation of its prediction is told where it is so many times as large as the middle one."""


def said_of_single_rows(
    run: Run,
    trajectories: Trajectories,
    steps: str,
    predicted: Sequence[Array],
    spreads: Sequence[Array] | None = None,
) -> list[str]:
    """A sentence for each channel of which one measurement has most of the sum of squared errors, as an early row has
    before which unmeasured states are hardly known. `steps`: how many rows ahead predictions are (`1`, `10`, `all`);
    `predicted` [R, C], and their standard deviations `spreads` if they are known, are those of the rows of each
    trajectory from its start on."""
    scales, out = run.fit.error_scales(run.model), []
    rows = [np.flatnonzero(item.times >= item.start) for item in trajectories.items]
    measured = np.concatenate([item.values[here] for item, here in zip(trajectories.items, rows, strict=True)])
    found = np.concatenate(list(predicted))
    values, fitted = on_error_scales(scales, measured, found)
    squares = np.nan_to_num((fitted - values) ** 2)
    owner = np.repeat(np.arange(len(rows)), [len(here) for here in rows])
    for j, channel in enumerate(run.model.channels):
        counted, row = np.isfinite(fitted[:, j] - values[:, j]), int(np.argmax(squares[:, j]))
        total = float(squares[:, j].sum())
        if counted.sum() < ENOUGH or not squares[row, j] > MOST * total:
            continue
        item, mine = trajectories.items[owner[row]], np.flatnonzero(owner == owner[row])
        number = int(np.isfinite(measured[mine[mine <= row]]).any(axis=1).sum())
        time = item.times[rows[owner[row]]][int(np.searchsorted(mine, row))]
        without = np.where(np.arange(len(found)) == row, np.nan, found[:, j])
        rest = channel_errors(measured[:, j], without, scales[j])
        unit = f" {channel.unit}" if channel.unit else ""
        ahead = {"1": "1 row ahead", "all": "from the start alone"}.get(steps, f"{steps} rows ahead")
        of = OF_LOGARITHMS if scales[j].logarithms else OF_COUNTS if scales[j].size is not None else ""
        error = f"nrmse is {rest.nrmse:.4g}" if of else f"rmse is {rest.rmse:.4g}"
        out.append(
            f"one row has {100 * squares[row, j] / total:.3g} % of the squared errors of `{channel.name}` {ahead}"
            f"{f' ({of})' if of else ''}: "
            f"{run.model.time.name} = {time:.6g}, measured row {number} of trajectory `{item.label}` (measured "
            f"{measured[row, j]:.4g}{unit}, predicted {found[row, j]:.4g}{unit}){_wide(spreads, row, j, counted)}. "
            f"Without it {error}"
        )
    return out


def _wide(spreads: Sequence[Array] | None, row: int, channel: int, counted: Array) -> str:
    """That the prediction of a row was known to be less certain than others."""
    if spreads is None:
        return ""
    each = np.concatenate(list(spreads))[:, channel]
    usual = float(np.median(each[counted]))
    if not each[row] > WIDE * usual:
        return ""
    return (
        f"; that prediction is an uncertain one, with a standard deviation of {each[row]:.2g} (median of all: "
        f"{usual:.2g})"
    )
