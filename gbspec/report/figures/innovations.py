"""Standardised innovations of a disturbed model, with their autocorrelation and cumulated periodogram."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.report.description import Axis, Block, Figure, Line, Panel, Row
from gbspec.report.source import MissingError, Source
from gbspec.report.style import MEMBERS

GREY = "#98a2b3"
MOST = 4
"""The most channels that are shown."""
BOUND, DISTANCE = 1.96, 1.358
"""The 95 % bounds of an autocorrelation and of a cumulated periodogram's distance, times the root of the number."""


def build(source: Source) -> Figure:
    """A row of three panels for each channel, of the best member."""
    from gbspec.training import filter_run

    model = source.run.model
    if not model.diffusions:
        raise MissingError("the model has no `diffusion`, and so no innovations", "parity")
    filtered = filter_run(source.run, source.fitted.data, source.run.best)
    rows = []
    for j, channel in enumerate(model.channels[:MOST]):
        tested = filtered.whiteness(j)
        if tested is None:
            continue
        series = np.concatenate(filtered.standardised(j))
        lags = np.arange(1, len(tested.autocorrelations) + 1, dtype=np.float64)
        share = np.linspace(0, 0.5, len(tested.cumulated))
        bound = BOUND / np.sqrt(tested.values)
        distance = DISTANCE / np.sqrt(max(len(share), 1))
        rows.append(
            Row(
                (
                    _panel(np.arange(len(series), dtype=np.float64), series, "row", channel.name, [-BOUND, BOUND]),
                    _panel(lags, tested.autocorrelations, "lag", "autocorrelation", [-bound, bound]),
                    _panel(share, tested.cumulated, "frequency (1/row)", "periodogram", [-distance, distance], True),
                )
            )
        )
    if not rows:
        raise MissingError("there are too few values to test, or the moments are not finite", "parity")
    return Figure(((Block(tuple(rows)),),))


def _panel(x: Array, y: Array, across: str, up: str, bounds: list[float], diagonal: bool = False) -> Panel:
    """A line with dashed bounds around zero, or around the diagonal."""
    middle = 2 * x if diagonal else np.zeros(len(x))
    limits = [Line(x, middle + each, "", GREY, 1.0, dash="dashed") for each in bounds]
    return Panel((*limits, Line(x, y, "", MEMBERS[0], 1.0)), Axis(across), Axis(up), width=3.2, height=2.0)
