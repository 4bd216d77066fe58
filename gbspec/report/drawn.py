"""Descriptions of figures drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import takewhile, zip_longest
from typing import TYPE_CHECKING, Any, TypeAlias, assert_never

import numpy as np

from gbspec.report import style
from gbspec.report.breaking import HEADING, LABEL, TITLE, broken
from gbspec.report.description import (
    Axis,
    Band,
    Bars,
    Block,
    Heat,
    Line,
    Mark,
    Panel,
    Points,
    Rug,
    Rule,
    Span,
    Text,
)
from gbspec.report.description import Figure as Description

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

Look: TypeAlias = Any
"""A value of a matplotlib property; their types have nothing in common."""
DASHES: dict[str, Look] = {"solid": "solid", "dashed": (0, (3.4, 2.2)), "dotted": "dotted"}
MARKERS = {"circle": "o", "square": "s", "diamond": "D", "up": "^", "down": "v", "plus": "P", "cross": "x", "bar": "|"}
LEGEND = 0.4
"""Inches that a legend below or above a block takes."""
MARGIN, PLAIN, BESIDE, LOW = 0.7, 0.2, 0.5, 1.1
"""Inches of a panel beside its axes, with and without what the y axis is called, and below and above these; what a
y axis is called may reach beyond a low panel."""
UPRIGHT = 6.0
"""Upright names per inch."""
IN_A_ROW = 5
"""Entries of a legend side by side."""
LEAST_WIDTH = 5.2
"""Width in inches below which a legend would be wider than its figure."""


def drawn(shown: Description) -> Figure:
    """The figure as matplotlib draws it; nothing global is changed."""
    with style.styled():
        heights = [max(_height(block) for block in row) for row in shown.rows]
        widths = [[_width(block) for block in row] for row in shown.rows]
        made = style.figure(max(LEAST_WIDTH, *(sum(row) for row in widths)), sum(heights))
        if len(shown.rows) == len(shown.rows[0]) == 1:
            _block(made, shown.rows[0][0])
            return made
        parts = made.subfigures(len(shown.rows), 1, squeeze=False, height_ratios=heights)[:, 0]
        for part, row, across in zip(parts, shown.rows, widths, strict=True):
            if len(row) == 1:
                _block(part, row[0])
                continue
            places = part.subfigures(1, len(row), squeeze=False, width_ratios=across, wspace=0.04)[0]
            for place, block in zip(places, row, strict=True):
                _block(place, block)
        return made


def _row_heights(block: Block) -> list[float]:
    return [max(panel.height for panel in row.panels if panel is not None) for row in block.rows]


def _column_widths(block: Block) -> list[float]:
    columns = zip_longest(*(row.panels for row in block.rows))
    return [max(panel.width for panel in column if panel is not None) for column in columns]


def _height(block: Block) -> float:
    return sum(_row_heights(block)) + (LEGEND if block.legend else 0.1)


def _width(block: Block) -> float:
    return sum(_column_widths(block))


def _margin(panel: Panel) -> float:
    return MARGIN if panel.y.shown and panel.y.label else PLAIN


def _free(panels: Sequence[Panel | None]) -> float:
    """The inches over the first of these panels, inside of its axes, and over those behind it up to the next one with
    a title."""
    first, *others = panels
    behind = takewhile(lambda panel: panel is None or not panel.title.strip(), others)
    return sum(panel.width for panel in (first, *behind) if panel is not None) - (_margin(first) if first else 0.0)


def _block(where: Figure | SubFigure, block: Block) -> None:
    heights, widths = _row_heights(block), _column_widths(block)
    share: Any = {"": False, "row": "row", "column": "col"}[block.shared]
    grid = where.subplots(len(heights), len(widths), squeeze=False, sharex=share, height_ratios=heights,
                          width_ratios=widths)  # fmt: skip
    for i, (axes, row) in enumerate(zip(grid, block.rows, strict=True)):
        for j, (one, panel) in enumerate(zip_longest(axes, row.panels)):
            if panel is None:
                one.set_axis_off()
                continue
            _panel(one, panel, where)
            if panel.title:
                one.set_title(broken(panel.title, _free(row.panels[j:]), TITLE), fontsize=8.5)
            if block.shared and i < len(heights) - 1:
                one.set_xlabel("")
        first = row.panels[0]
        if row.heading and first is not None and not first.title:
            axes[0].set_title(broken(row.heading, _free(row.panels), HEADING))
    if block.legend:
        entries = dict(_entries(grid.ravel().tolist()))
        if entries:
            place: Any = "outside lower center" if block.legend == "below" else "outside upper right"
            where.legend(list(entries.values()), list(entries), loc=place, ncols=min(len(entries), IN_A_ROW))


def _entries(panels: Sequence[Axes]) -> Iterator[tuple[str, Artist]]:
    """Labels and their artists; labels may be repeated."""
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            yield label, handle


def _panel(axes: Axes, panel: Panel, where: Figure | SubFigure) -> None:
    for mark in panel.marks:
        _draw(axes, mark, where)
    inside = panel.width - _margin(panel)
    axes.set_xlabel(broken(panel.x.title, inside, LABEL))
    beside = BESIDE + (_named(axes, panel.x, inside) if panel.x.names else 0.0)
    axes.set_ylabel(broken(panel.y.title, max(LOW, panel.height - beside), LABEL))
    for axis, scale, limit, margin in (
        (panel.x, axes.set_xscale, axes.set_xlim, axes.set_xmargin),
        (panel.y, axes.set_yscale, axes.set_ylim, axes.set_ymargin),
    ):
        if axis.log:
            scale("log")
        if axis.margin is not None:
            margin(axis.margin)
        if axis.range is not None:
            limit(*axis.range)
    axes.autoscale_view()
    if not panel.y.shown:
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.grid(visible=False, axis="y")
    entries = dict(_entries([axes]))
    if panel.legend and len(entries) > 1:
        axes.legend(list(entries.values()), list(entries), loc="best")


def _named(axes: Axes, axis: Axis, inches: float) -> float:
    """Names at the places of an x axis, upright where they would overlap, and not all where even these would. Returns
    the inches by which upright ones make the panel lower."""
    shown = axis.ticks(int(inches * UPRIGHT))
    upright = sum(len(name) + 2 for _, name in shown) > inches * LABEL
    axes.set_xticks([place for place, _ in shown], [name for _, name in shown], rotation=90 if upright else 0)
    return max(len(name) for _, name in shown) / LABEL if upright else 0.0


def _draw(axes: Axes, mark: Mark, where: Figure | SubFigure) -> None:
    # matplotlib leaves labels that begin with an underscore out of legends
    label = getattr(mark, "label", "") or "_"
    match mark:
        case Line():
            axes.plot(mark.x, mark.y, color=mark.color, linewidth=mark.width, linestyle=DASHES[mark.dash],
                      alpha=mark.alpha, zorder=mark.layer, label=label)  # fmt: skip
        case Points():
            _points(axes, mark, label)
        case Band():
            axes.fill_between(mark.x, mark.low, mark.high, color=mark.color, alpha=mark.alpha, linewidth=0, zorder=2,
                              label=label)  # fmt: skip
        case Span():
            span = axes.axvspan if mark.axis == "x" else axes.axhspan
            span(mark.low, mark.high, color=mark.color, alpha=mark.alpha, linewidth=0, zorder=0, label=label)
        case Rule():
            rule = axes.axvline if mark.axis == "x" else axes.axhline
            rule(mark.value, color=mark.color, linewidth=mark.width, linestyle=DASHES[mark.dash], zorder=2, label=label)
        case Rug():
            look: dict[str, Look] = {"color": mark.color, "markersize": 7, "alpha": 0.35, "markeredgewidth": 0.7}
            at = axes.get_xaxis_transform()
            axes.plot(mark.x, np.zeros(len(mark.x)), "|", transform=at, clip_on=False, zorder=5, **look)
        case Heat():
            mesh = axes.pcolormesh(mark.x, mark.y, mark.values, vmin=mark.low, vmax=mark.high, cmap="viridis",
                                   shading="nearest", rasterized=True)  # fmt: skip
            axes.grid(visible=False)
            axes.set_facecolor("#f2f4f7")
            where.colorbar(mesh, ax=axes, fraction=0.06, pad=0.03)
        case Bars():
            axes.barh(mark.edges[:-1], mark.counts, np.diff(mark.edges), align="edge", color=mark.color, alpha=0.8)
        case Text():
            place: dict[str, Look] = {"transform": axes.get_xaxis_transform(), "ha": "center", "va": "bottom"}
            axes.text(mark.x, 1.01, mark.text, fontsize=7.5, color="#555555", **place)
        case _:
            assert_never(mark)


def _points(axes: Axes, mark: Points, label: str) -> None:
    look: dict[str, Look] = {"color": mark.color, "alpha": mark.alpha, "markersize": mark.size}
    if mark.hollow:
        look |= {"markerfacecolor": "white"}
    elif mark.outlined:
        look |= {"markeredgecolor": "white"}
    elif mark.marker not in ("cross", "bar"):
        look |= {"markeredgewidth": 0.0}
    axes.plot(mark.x, mark.y, MARKERS[mark.marker], zorder=mark.layer, label=label, rasterized=len(mark.x) > RASTER,
              **look)  # fmt: skip


RASTER = 1000
"""Number of points from which a file contains an image of them instead of each point."""
