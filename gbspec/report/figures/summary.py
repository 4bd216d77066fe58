"""One figure of a run: a trajectory's fit, a learned function with its truth, and the constants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gbspec.arrays import Array
from gbspec.data import Trajectories, channel_scales
from gbspec.report import collect
from gbspec.report.content import LearnedConstant, LearnedFunction, TrajectoryFit
from gbspec.report.description import Axis, Block, Figure, Panel, Row
from gbspec.report.figures import constants, fit, functions
from gbspec.report.source import Source

UPPER, LOWER = 2.4, 2.9
"""Heights of the two halves."""
WIDE, NARROW = 4.3, 2.9
"""Widths of the panels."""


def build(source: Source) -> Figure:
    """The requested trajectory, else the one that varies most, with the first unknown and the constants."""
    fitted = source.fitted
    index = (source.chosen() or [liveliest(fitted.data)])[0]
    (shown,) = collect.trajectory_fits(fitted, [index])
    learned = source.functions
    return figure(shown, learned[0] if learned else None, collect.constants(source.run),
                  fitted.model.time.name, fitted.model.time.unit or "")  # fmt: skip


def figure(
    shown: TrajectoryFit,
    function: LearnedFunction | None,
    learned: Sequence[LearnedConstant],
    time: str,
    unit: str = "",
) -> Figure:
    """The fit above, the function and the constants below."""
    channels = tuple(
        replace(fit.panel(channel, Axis(time, unit, margin=0.02), height=UPPER), width=WIDE)
        for channel in shown.channels
    )
    rows = [(Block((Row(channels, fit.heading(shown)),), "above"),)]
    lower = []
    if function is not None:
        lower.append(Block((Row(_function(function)),)))
    if learned:
        panels = (replace(constants.panel(one, height=LOWER / len(learned)), width=NARROW) for one in learned)
        lower.append(Block(tuple(Row((panel,)) for panel in panels)))
    return Figure((*rows, tuple(lower)) if lower else tuple(rows))


def _function(function: LearnedFunction) -> tuple[Panel | None, ...]:
    """The slice along which a function varies most, and the comparison with its truth or the next slice."""
    panels = [functions.slice_panel(function.name, function.slices[0], function.unit)]
    if function.truth is not None:
        panels.append(
            functions.parity_panel(function.name, function.truth, function.members.mean(axis=0), function.unit)
        )
    elif len(function.slices) > 1:
        panels.append(functions.slice_panel(function.name, function.slices[1], function.unit, legend=False))
    return tuple(replace(panel, width=NARROW, height=LOWER) for panel in panels)


def liveliest(data: Trajectories) -> int:
    """The trajectory whose channels change most from row to row."""

    def change(values: Array) -> float:
        return float(sum(np.abs(np.diff(column[np.isfinite(column)])).sum() for column in values.T))

    scales = channel_scales(data)
    return int(np.argmax([change(item.values / scales) for item in data.items]))
