"""The figures, each from plain arrays (`gbspec.report.content`) to a matplotlib Figure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from gbspec.report import style
from gbspec.report.content import (
    ChannelFit,
    History,
    LearnedConstant,
    LearnedFunction,
    Orbit,
    Plane,
    Residuals,
    Slice,
    TrajectoryFit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

P = ParamSpec("P")
ACROSS = 3
"""Panels side by side in a figure of functions."""
SLICES = 3
"""Slices of one function that are shown; those along which it varies most come first."""


def _styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Runs a drawing function under the settings of `style`."""

    def drawn(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with style.styled():
            return draw(*args, **kwargs)

    drawn.__name__, drawn.__doc__ = draw.__name__, draw.__doc__
    return drawn


# ------------------------------------------------------------------------------------------------------------ fit
@_styled
def fit(trajectories: Sequence[TrajectoryFit], time: str = "t") -> Figure:
    """One row a trajectory, one column a channel: measurements, the learned curve, the truth where there is one."""
    rows, columns = len(trajectories), max(len(t.channels) for t in trajectories)
    made = style.figure(max(3.3 * columns, 4.2), 1.9 * rows + 0.5)
    axes = made.subplots(rows, columns, squeeze=False, sharex="row")
    for i, trajectory in enumerate(trajectories):
        for j in range(columns):
            if j >= len(trajectory.channels):
                axes[i, j].set_axis_off()
                continue
            draw_channel(axes[i, j], trajectory.channels[j])
            if j == 0:
                axes[i, j].set_title(_heading(trajectory))
            if i == rows - 1:
                axes[i, j].set_xlabel(time)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return made


def draw_channel(axes: Axes, channel: ChannelFit) -> None:
    """Measurements, fit and truth of one channel into given axes."""
    style.band(axes, channel.grid, channel.members)
    if channel.truth is not None:
        style.truth_line(axes, channel.grid, channel.truth)
    style.points(axes, channel.times, channel.measured)
    axes.set_ylabel(channel.name + (f" [{channel.unit}]" if channel.unit else ""))
    axes.margins(x=0.02)


def _heading(trajectory: TrajectoryFit) -> str:
    name = f"trajectory {trajectory.label}" if trajectory.label else ""
    return ", ".join(part for part in (name, trajectory.condition) if part)


# ------------------------------------------------------------------------------------------------------ functions
@_styled
def functions(learned: Sequence[LearnedFunction]) -> Figure:
    """A block a function: slices through it, its plane where it has two arguments or more, parity with the truth."""
    rows = [-(-_panels(function) // ACROSS) for function in learned]
    made = style.figure(3.3 * min(ACROSS, max(_panels(function) for function in learned)) + 0.4, 2.8 * sum(rows) + 0.2)
    blocks = made.subfigures(len(learned), 1, squeeze=False, height_ratios=rows)[:, 0]
    for block, function, count in zip(blocks, learned, rows, strict=True):
        columns = min(ACROSS, _panels(function))
        panels = list(block.subplots(count, columns, squeeze=False).ravel())
        for spare in panels[_draw_function(block, panels, function) :]:
            spare.set_axis_off()
    return made


def _panels(function: LearnedFunction) -> int:
    planes = 0 if function.plane is None else (1 if function.plane.truth is None else 2)
    return max(1, min(len(function.slices), SLICES) + planes + (function.truth is not None))


def _draw_function(block: SubFigure, panels: Sequence[Axes], function: LearnedFunction) -> int:
    used = 0
    for piece in function.slices[:SLICES]:
        draw_slice(panels[used], function.name, piece, legend=used == 0)
        used += 1
    if function.plane is not None:
        used += _draw_plane(block, panels[used:], function.name, function.plane)
    if function.truth is not None:
        draw_parity(panels[used], function)
        used += 1
    return used


def draw_slice(axes: Axes, name: str, piece: Slice, *, legend: bool = True) -> None:
    """A learned function along one argument, beside the truth and the postulate; ticks show where data are."""
    if piece.postulate is not None:
        axes.plot(piece.x, piece.postulate, color=style.MUTED, linestyle="dotted", linewidth=1.5, label="postulate")
    style.band(axes, piece.x, piece.members)
    if piece.truth is not None:
        style.truth_line(axes, piece.x, piece.truth)
    if piece.visited is not None:
        at = np.zeros(len(piece.visited))
        look: Any = {"color": style.MEASURED, "markersize": 7, "alpha": 0.35, "markeredgewidth": 0.7}
        axes.plot(piece.visited, at, "|", transform=axes.get_xaxis_transform(), clip_on=False, zorder=5, **look)
    axes.set_xlabel(piece.argument)
    axes.set_ylabel(name)
    axes.set_title(f"{name}" + (f" at {piece.label}" if piece.label else ""), fontsize=8.5)
    axes.margins(x=0.02)
    if legend:
        axes.legend(loc="best")


def _draw_plane(block: SubFigure, row: Sequence[Axes], name: str, plane: Plane) -> int:
    shown = [("learned", plane.learned)] + ([("truth", plane.truth)] if plane.truth is not None else [])
    low = min(float(np.nanmin(values)) for _, values in shown)
    high = max(float(np.nanmax(values)) for _, values in shown)
    for axes, (word, values) in zip(row, shown, strict=False):
        mesh = axes.pcolormesh(
            plane.x, plane.y, values, vmin=low, vmax=high, cmap="viridis", shading="nearest", rasterized=True
        )
        axes.set_xlabel(plane.x_name)
        axes.set_ylabel(plane.y_name)
        axes.set_title(f"{name}, {word}" + (f" at {plane.label}" if plane.label else ""), fontsize=8.5)
        axes.grid(visible=False)
        axes.set_facecolor("#f2f4f7")
        block.colorbar(mesh, ax=axes, fraction=0.06, pad=0.03)
    return len(shown)


def draw_parity(axes: Axes, function: LearnedFunction) -> None:
    """Learned against true values at the points that the data visit, the outermost two in a thousand left out."""
    if function.truth is None:
        raise ValueError("parity needs a truth")
    learned, truth = function.members.mean(axis=0), function.truth
    low, high = np.quantile(np.concatenate([learned, truth]), [0.002, 0.998])
    shown = (np.minimum(learned, truth) >= low) & (np.maximum(learned, truth) <= high)
    axes.plot([low, high], [low, high], color=style.MUTED, linewidth=0.9, zorder=2)
    axes.plot(
        truth[shown], learned[shown], ".", color=style.LEARNED, markersize=3, alpha=0.45, zorder=3, rasterized=True
    )
    axes.set_xlabel(f"true {function.name}")
    axes.set_ylabel(f"learned {function.name}")
    error = float(np.median(np.abs(learned - truth)))
    share = f"{100 * error / (high - low):.2g} % of range" if high > low else f"{error:.2g}"
    axes.set_title(f"median error {share}", fontsize=8.5)


# ------------------------------------------------------------------------------------------------------ constants
@_styled
def constants(learned: Sequence[LearnedConstant]) -> Figure:
    """One row a constant, each on its own axis: value, interval, members, start and truth."""
    made = style.figure(5.6, 0.85 * len(learned) + 0.75)
    column = made.subplots(len(learned), 1, squeeze=False)[:, 0]
    for axes, constant in zip(column, learned, strict=True):
        draw_constant(axes, constant)
    handles: dict[str, Any] = {}
    for axes in column:
        handles.update({label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)})
    made.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
    return made


def draw_constant(axes: Axes, constant: LearnedConstant) -> None:
    """One constant on a horizontal axis of its own."""
    if constant.interval is not None:
        bar: Any = {"color": style.LEARNED, "linewidth": 4, "alpha": 0.35, "solid_capstyle": "butt"}
        axes.plot(constant.interval, [0, 0], label="interval", zorder=2, **bar)
    if len(constant.members) > 1:
        at = np.zeros(len(constant.members))
        axes.plot(constant.members, at, "|", color=style.LEARNED, markersize=11, label="members", zorder=3)
    axes.plot([constant.value], [0], "o", color=style.LEARNED, markersize=6, label="learned", zorder=5)
    if constant.truth is not None:
        axes.axvline(constant.truth, label="truth", zorder=4, **style.DASHED)
    if constant.start is not None:
        axes.plot([constant.start], [0], "x", color=style.MUTED, markersize=6, label="start", zorder=3)
    axes.set_yticks([])
    axes.set_ylim(-1, 1)
    axes.spines["left"].set_visible(False)
    axes.grid(visible=False, axis="y")
    axes.margins(x=0.08)
    said = f"{constant.name} = {constant.value:.5g}"
    if constant.truth:
        said += f", {100 * abs(constant.value / constant.truth - 1):.2g} % from the truth"
    axes.set_title(said, fontsize=8.5)


# -------------------------------------------------------------------------------------------------------- history
@_styled
def history(members: Sequence[History]) -> Figure:
    """The loss against time of training, stages shaded, and below it each learned constant."""
    names = list(members[0].constants)
    made = style.figure(6.4, 2.6 + 1.25 * len(names))
    ratios = [2.0, *([1.0] * len(names))]
    column = made.subplots(1 + len(names), 1, squeeze=False, sharex=True, height_ratios=ratios)[:, 0]
    _draw_stages(list(column), members[0])
    for k, member in enumerate(members):
        color = style.MEMBERS[k % len(style.MEMBERS)]
        column[0].plot(member.seconds, member.loss, color=color, linewidth=1.3, label=f"member {member.member}")
        for axes, name in zip(column[1:], names, strict=True):
            axes.plot(member.seconds, member.constants[name], color=color, linewidth=1.3)
    column[0].set_yscale("log")
    column[0].set_ylabel("loss")
    if len(members) > 1:
        column[0].legend(ncols=min(len(members), 5))
    for axes, name in zip(column[1:], names, strict=True):
        axes.set_ylabel(name)
    column[-1].set_xlabel("seconds")
    return made


def _draw_stages(column: Sequence[Axes], member: History) -> None:
    """Shades every other stage of a member and writes the stages' names over the loss."""
    if not member.stage:
        return
    starts = [0, *(i for i in range(1, len(member.stage)) if member.stage[i] != member.stage[i - 1])]
    ends = [*starts[1:], len(member.stage) - 1]
    total = float(member.seconds[-1] - member.seconds[0]) or 1.0
    for k, (first, last) in enumerate(zip(starts, ends, strict=True)):
        left, right = float(member.seconds[first]), float(member.seconds[last])
        for axes in column:
            if k % 2:
                axes.axvspan(left, right, color="#f2f4f7", linewidth=0, zorder=0)
        if (right - left) / total > 0.013 * len(member.stage[first]):
            place: Any = {"transform": column[0].get_xaxis_transform(), "ha": "center", "va": "bottom"}
            column[0].text((left + right) / 2, 1.01, member.stage[first], fontsize=7.5, color="#555555", **place)


# ------------------------------------------------------------------------------------------------------ residuals
@_styled
def residuals(channels: Sequence[Residuals]) -> Figure:
    """For each channel: residuals in standard deviations against time, against the fit, and their distribution."""
    made = style.figure(9.6, 2.15 * len(channels) + 0.3)
    axes = made.subplots(len(channels), 3, squeeze=False, width_ratios=[2, 2, 1])
    for row, channel in zip(axes, channels, strict=True):
        for panel, x, label in ((row[0], channel.times, "time"), (row[1], channel.fitted, f"fitted {channel.name}")):
            panel.axhline(0, color=style.MUTED, linewidth=0.9, zorder=2)
            panel.plot(x, channel.residual, ".", color=style.LEARNED, markersize=3.5, alpha=0.5, zorder=3)
            panel.set_xlabel(label)
        row[0].set_ylabel("residual / sd")
        row[0].set_title(f"{channel.name}: {len(channel.residual)} values, rms {_rms(channel.residual):.2g} sd")
        bins = _bins(len(channel.residual))
        row[2].hist(channel.residual, bins=bins, color=style.LEARNED, alpha=0.8, orientation="horizontal")
        row[2].set_xlabel("count")
    return made


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def _bins(count: int) -> int:
    return max(5, min(40, int(math.sqrt(max(count, 1)))))


# ---------------------------------------------------------------------------------------------------------- phase
@_styled
def phase(orbits: Sequence[Orbit], x: str, y: str) -> Figure:
    """Trajectories in the plane of two states, the truth dashed, joint measurements as points."""
    made = style.figure(5.2, 4.4)
    axes = made.subplots()
    for k, orbit in enumerate(orbits):
        first = k == 0
        path, seen = orbit.learned, orbit.measured
        label = "learned" if first else None
        axes.plot(path[:, 0], path[:, 1], color=style.LEARNED, linewidth=1.2, alpha=0.85, label=label, zorder=3)
        axes.plot(path[0, 0], path[0, 1], marker="o", color=style.LEARNED, markersize=3.5, zorder=4)
        if orbit.truth is not None:
            style.truth_line(axes, orbit.truth[:, 0], orbit.truth[:, 1], "truth" if first else "")
        if len(seen):
            style.points(axes, seen[:, 0], seen[:, 1], "measured" if first else "")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.legend()
    return made


# -------------------------------------------------------------------------------------------------------- summary
@_styled
def summary(
    shown: TrajectoryFit, function: LearnedFunction | None, learned: Sequence[LearnedConstant], time: str
) -> Figure:
    """One picture of a run: a trajectory's fit above; a learned function beside its truth and the constants below."""
    columns = max(len(shown.channels), 2)
    made = style.figure(4.3 * columns, 5.6)
    upper, lower = made.subfigures(2, 1, squeeze=False, height_ratios=[1, 1.02])[:, 0]
    top = np.ravel(upper.subplots(1, len(shown.channels)))
    for axes, channel in zip(top, shown.channels, strict=True):
        draw_channel(axes, channel)
        axes.set_xlabel(time)
    top[0].set_title(_heading(shown))
    handles, labels = top[0].get_legend_handles_labels()
    upper.legend(handles, labels, loc="outside upper right", ncols=len(labels))
    both = function is not None and bool(learned)
    parts = list(lower.subfigures(1, 2, squeeze=False, width_ratios=[2, 1], wspace=0.04)[0]) if both else [lower, lower]
    if function is not None:
        panels = np.ravel(parts[0].subplots(1, 2))
        draw_slice(panels[0], function.name, function.slices[0])
        if function.truth is not None:
            draw_parity(panels[1], function)
        elif len(function.slices) > 1:
            draw_slice(panels[1], function.name, function.slices[1], legend=False)
        else:
            panels[1].set_axis_off()
    if learned:
        for axes, constant in zip(np.ravel(parts[1].subplots(len(learned), 1)), learned, strict=True):
            draw_constant(axes, constant)
    return made
