"""The channels, unmeasured states, inputs and doses of each trajectory, over one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gbspec.report.collect import trajectory_fits
from gbspec.report.content import ChannelFit, Given, TrajectoryFit
from gbspec.report.description import (
    Axis,
    Block,
    Figure,
    Line,
    Mark,
    Panel,
    Points,
    Row,
    ensemble,
    measured,
    true_solution,
)
from gbspec.report.source import Source
from gbspec.report.style import MUTED

IN_FILE, ON_PAGE = 4, 24
"""Number of trajectories if none are named."""
VALUES = 20_000
"""Measured values on the page, above which it shows fewer trajectories, but at least one."""
ACROSS, WIDE = 2, 4.4
"""Trajectories side by side in a file, and the width of their panels."""
LONG, EXCERPT = 1000, 150
"""Rows from which a trajectory in a file is wide and has an excerpt beside it, and the rows of the excerpt."""


def build(source: Source) -> Figure:
    """The fit of some trajectories, with the states that are not measured."""
    fitted = source.fitted
    width = max(1, len(fitted.model.channels))
    rows = max(1, int(np.mean([len(item.times) for item in fitted.data.items])))
    found = trajectory_fits(fitted, source.some(IN_FILE, min(ON_PAGE, max(1, VALUES // (rows * width)))), hidden=True)
    time = fitted.model.time
    return figure(found, time.name, time.unit or "", page=source.page)


def figure(trajectories: Sequence[TrajectoryFit], time: str = "t", unit: str = "", *, page: bool = False) -> Figure:
    """One block per trajectory, with one time axis; in a file `ACROSS` side by side, or one with an excerpt."""
    blocks = [block(trajectory, time, unit, page=page) for trajectory in trajectories]
    across = 1 if page or any(len(one.rows[0].panels) > 1 for one in blocks) else ACROSS
    rows = [tuple(blocks[start : start + across]) for start in range(0, len(blocks), across)]
    # One legend stands for all: the marks are the same in every block
    return Figure((*(tuple(replace(one, legend="") for one in row) for row in rows[:-1]), rows[-1]))


def block(trajectory: TrajectoryFit, time: str = "t", unit: str = "", *, page: bool = False) -> Block:
    """One trajectory: what is measured, then unmeasured states, then inputs and doses."""
    axis = Axis(time, unit, margin=0.02)
    note = "; ".join(
        text for text in (trajectory.own, f"initial state: {trajectory.origin}" if trajectory.origin else "") if text
    )
    long = max((len(channel.times) for channel in trajectory.channels), default=0) > LONG and not page
    part = _excerpt(trajectory) if long else None
    rows: list[Row] = []
    drawn = [
        *(panel(channel, axis) for channel in trajectory.channels),
        *(_given(one, axis) for one in trajectory.given),
    ]
    for one in drawn:
        if part is None:
            panels: tuple[Panel, ...] = (replace(one, width=WIDE),)
        else:
            panels = (replace(one, width=1.5 * WIDE), replace(_cut(one, part), width=0.75 * WIDE))
        rows.append(Row(panels, "" if rows else heading(trajectory), "" if rows else note))
    return Block(tuple(rows), "below", "column", chosen=True)


def panel(channel: ChannelFit, axis: Axis, *, legend: bool = False, height: float = 1.9) -> Panel:
    """One channel, or state, of one trajectory."""
    marks: list[Mark] = [*ensemble(channel.grid, channel.members, channel.solution)]
    if channel.truth is not None:
        marks.append(true_solution(channel.grid, channel.truth))
    if channel.below is not None:
        marks.append(Points(channel.below[0], channel.below[1], "below", MUTED, 4.2, "down"))
    if channel.above is not None:
        marks.append(Points(channel.above[0], channel.above[1], "above", MUTED, 4.2, "up"))
    if len(channel.times):
        points = measured(channel.times, channel.measured)
        # The page draws marks in their order, files by their layers
        marks = [points, *marks] if points.layer < 3 else [*marks, points]
    title = "" if len(channel.times) else f"{channel.name}: not measured"
    return Panel(tuple(marks), axis, Axis(channel.name, channel.unit), title, legend, height=height)


def _given(one: Given, axis: Axis) -> Panel:
    """An input over time, or doses as stems."""
    if not one.doses:
        marks: tuple[Mark, ...] = (Line(one.times, one.values, "input", MUTED, 1.5),)
        return Panel(marks, axis, Axis(one.name, one.unit, margin=0.1), height=1.1)
    gaps = np.full(len(one.times), np.nan)
    x = np.column_stack([one.times, one.times, gaps]).ravel()
    y = np.column_stack([np.zeros(len(one.times)), one.values, gaps]).ravel()
    marks = (Line(x, y, color=MUTED, width=1.5), Points(one.times, one.values, "dose", MUTED, 4.2, "down"))
    return Panel(marks, axis, Axis(one.name, one.unit, range=(0.0, 1.2 * float(one.values.max()) or 1.0)), height=1.1)


def _excerpt(trajectory: TrajectoryFit) -> tuple[float, float]:
    """The range of times around the rows that the model follows worst."""
    channel = max(trajectory.channels, key=lambda one: len(one.times))
    error = np.abs(np.interp(channel.times, channel.grid, channel.members.mean(axis=0)) - channel.measured)
    smooth = np.convolve(np.where(np.isfinite(error), error, 0.0), np.ones(EXCERPT), "valid")
    first = int(np.argmax(smooth))
    return float(channel.times[first]), float(channel.times[first + EXCERPT - 1])


def _cut(whole: Panel, part: tuple[float, float]) -> Panel:
    """A panel between two times, where its measurements are drawn as single points over the curve."""
    marks = tuple(
        replace(mark, size=3.0, alpha=0.9, layer=5) if isinstance(mark, Points) and mark.label == "measured" else mark
        for mark in whole.marks
    )
    return replace(whole, marks=marks, x=replace(whole.x, range=part), y=replace(whole.y, label="", unit=""),
                   title="around the largest errors" if not whole.title else " ")  # fmt: skip


def heading(trajectory: TrajectoryFit) -> str:
    """A trajectory's label and condition."""
    name = f"trajectory {trajectory.label}" if trajectory.label else ""
    return ", ".join(part for part in (name, trajectory.condition) if part)
