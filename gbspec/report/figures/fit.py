"""Measurements, learned solution and truth: one row per trajectory, one panel per channel."""

from __future__ import annotations

from collections.abc import Sequence

from gbspec.report.collect import trajectory_fits
from gbspec.report.content import ChannelFit, TrajectoryFit
from gbspec.report.description import Axis, Block, Figure, Mark, Panel, Row, ensemble, measured, truth
from gbspec.report.source import Source

IN_FILE, ON_PAGE = 4, 24
"""Number of trajectories if none are named."""


def build(source: Source) -> Figure:
    """The fit of some trajectories; on the page also of the states that are not measured."""
    fitted = source.fitted
    found = trajectory_fits(fitted, source.some(IN_FILE, ON_PAGE), hidden=source.page)
    return figure(found, fitted.model.time.name)


def figure(trajectories: Sequence[TrajectoryFit], time: str = "t") -> Figure:
    """One row per trajectory, one column per channel."""
    columns = max(len(trajectory.channels) for trajectory in trajectories)
    rows = []
    for trajectory in trajectories:
        panels = [panel(channel, time) for channel in trajectory.channels]
        note = f"initial state: {trajectory.origin}" if trajectory.origin else ""
        rows.append(Row((*panels, *([None] * (columns - len(panels)))), heading(trajectory), note))
    return Figure(((Block(tuple(rows), "below", "row", chosen=True),),))


def panel(channel: ChannelFit, time: str, *, legend: bool = False, height: float = 2.1) -> Panel:
    """One channel, or state, of one trajectory."""
    marks: list[Mark] = [*ensemble(channel.grid, channel.members)]
    if channel.truth is not None:
        marks.append(truth(channel.grid, channel.truth))
    if len(channel.times):
        marks.append(measured(channel.times, channel.measured))
    title = "" if len(channel.times) else f"{channel.name}: not measured"
    x, y = Axis(time, margin=0.02), Axis(channel.name, channel.unit)
    return Panel(tuple(marks), x, y, title, legend, height=height)


def heading(trajectory: TrajectoryFit) -> str:
    """A trajectory's label and condition."""
    name = f"trajectory {trajectory.label}" if trajectory.label else ""
    return ", ".join(part for part in (name, trajectory.condition) if part)
