"""The residuals of the fit over time and over the predicted values, and their distribution."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gbspec.frames import counted
from gbspec.report import collect
from gbspec.report.content import Residuals
from gbspec.report.description import Axis, Bars, Block, Figure, Panel, Points, Row, Rule
from gbspec.report.source import Source
from gbspec.report.style import LEARNED


def build(source: Source) -> Figure:
    """The residuals of every channel over all trajectories."""
    return figure(collect.residuals(source.fitted), source.fitted.model.time.name,
                  source.fitted.model.time.unit or "")  # fmt: skip


def figure(channels: Sequence[Residuals], time: str = "t", unit: str = "") -> Figure:
    """One row per channel."""
    return Figure(((Block(tuple(_row(channel, Axis(time, unit)) for channel in channels)),),))


def _row(channel: Residuals, time: Axis) -> Row:
    values = channel.residual
    rms = float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan
    y = Axis(f"scaled residual of {'ln ' if channel.logarithmic else ''}{channel.name}")
    counts, edges = np.histogram(values, bins=max(5, min(40, int(math.sqrt(max(len(values), 1))))))
    predicted = Axis(f"predicted {channel.name}", channel.unit)
    of = f"of the {channel.solution}" if channel.solution != "model" else ""  # another one than the fit minimises
    titles = (f"{channel.name}: {counted(len(values), 'value')}, rms {rms:.2g}", of)
    panels = [
        Panel((Rule("y", 0.0), Points(x, values, "residual", LEARNED, 2.8, alpha=0.5, layer=3)), axis, y, title,
              width=3.84, height=2.15)
        for (x, axis), title in zip(((channel.times, time), (channel.predicted, predicted)), titles, strict=True)
    ]  # fmt: skip
    return Row((*panels, Panel((Bars(edges, counts),), Axis("count"), y, width=1.92, height=2.15)))
