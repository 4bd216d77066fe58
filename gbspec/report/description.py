"""The description of a figure, drawn by matplotlib into files (`drawn`) and by plotly on the page (`html.charts`).

A figure is rows of blocks, a block rows of panels, a panel axes and marks. Panels are measured in inches, widths of
lines and sizes of marks in points; arrays are float64, and NaN leaves a gap. Marks with the same label share an entry
of the legend; those without a label have none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, TypeVar

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.report.breaking import cut
from gbspec.report.style import LEARNED, MEASURED, MUTED, TRUTH

Dash: TypeAlias = Literal["solid", "dashed", "dotted"]
Marker: TypeAlias = Literal["circle", "square", "diamond", "up", "down", "plus", "cross", "bar"]


@dataclass(frozen=True)
class Line:
    """A curve through `x`, `y` [P]; `hover` [P] are texts that the page shows at its points."""

    x: Array
    y: Array
    label: str = ""
    color: str = LEARNED
    width: float = 1.7
    dash: Dash = "solid"
    alpha: float = 1.0
    layer: float = 3
    hover: tuple[str, ...] = ()


@dataclass(frozen=True)
class Points:
    """Points at `x`, `y` [P]; `hollow` ones are filled white, `outlined` ones have a white edge (for few points)."""

    x: Array
    y: Array
    label: str = ""
    color: str = LEARNED
    size: float = 4.2
    marker: Marker = "circle"
    alpha: float = 1.0
    hollow: bool = False
    outlined: bool = False
    layer: float = 5
    hover: tuple[str, ...] = ()


@dataclass(frozen=True)
class Band:
    """The shaded area between `low` and `high` [P] over `x` [P]."""

    x: Array
    low: Array
    high: Array
    label: str = ""
    color: str = LEARNED
    alpha: float = 0.18


@dataclass(frozen=True)
class Span:
    """The shaded background of the panel between two values of one axis."""

    axis: Literal["x", "y"]
    low: float
    high: float
    label: str = ""
    color: str = "#eef0f3"
    alpha: float = 1.0


@dataclass(frozen=True)
class Rule:
    """A line across the panel at one value of an axis."""

    axis: Literal["x", "y"]
    value: float
    label: str = ""
    color: str = MUTED
    width: float = 0.9
    dash: Dash = "solid"


@dataclass(frozen=True)
class Rug:
    """Short ticks at the lower edge that show the positions of data."""

    x: Array
    color: str = MEASURED


@dataclass(frozen=True)
class Heat:
    """Colours of `values` [Y, X] over the grid `x` [X], `y` [Y], the same from `low` to `high` in every panel."""

    x: Array
    y: Array
    values: Array
    low: float
    high: float


@dataclass(frozen=True)
class Bars:
    """A horizontal histogram: `counts` [B] between the values `edges` [B + 1] of the y axis."""

    edges: Array
    counts: Array
    color: str = LEARNED


@dataclass(frozen=True)
class Text:
    """Words centered at `x` above the panel's upper edge."""

    x: float
    text: str


Mark: TypeAlias = Line | Points | Band | Span | Rule | Rug | Heat | Bars | Text


@dataclass(frozen=True)
class Axis:
    """An axis; without `range` it covers the marks, extended by the fraction `margin` at either end.

    `names` are those of the places 0, 1, 2, … of an axis that has no numbers.
    """

    label: str = ""
    unit: str = ""
    log: bool = False
    range: tuple[float, float] | None = None
    margin: float | None = None
    shown: bool = True
    names: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Label and unit."""
        return self.label + (f" [{self.unit}]" if self.unit else "")

    def ticks(self, most: int) -> list[tuple[int, str]]:
        """Places and their names, at most so many, of even distance; long names are cut."""
        every = max(1, -(-len(self.names) // max(1, most)))
        places = range(0, len(self.names), every)
        return list(zip(places, cut(self.names[::every], LONG), strict=True))


LONG = 16
"""Characters of a name at a place of an axis."""


@dataclass(frozen=True)
class Panel:
    """Marks over two axes; `legend`: in a file it has its own legend (on the page every panel has one)."""

    marks: tuple[Mark, ...]
    x: Axis
    y: Axis
    title: str = ""
    legend: bool = False
    width: float = 3.3
    height: float = 2.8


@dataclass(frozen=True)
class Row:
    """Panels side by side (None: an empty place); `heading` and `note` apply to all of them."""

    panels: tuple[Panel | None, ...]
    heading: str = ""
    note: str = ""


@dataclass(frozen=True)
class Block:
    """Rows of panels below each other, in columns.

    `legend` is where a file has the legend of all panels. `shared`: the panels of a row, or of a column, have the same
    x axis, which is then named once, below the last row; the page draws a column as one chart. `chosen`: the page shows
    one such block at a time.
    """

    rows: tuple[Row, ...]
    legend: Literal["", "below", "above"] = ""
    shared: Literal["", "row", "column"] = ""
    chosen: bool = False


@dataclass(frozen=True)
class Figure:
    """Rows of blocks."""

    rows: tuple[tuple[Block, ...], ...]


def single(panel: Panel, legend: Literal["", "below", "above"] = "") -> Figure:
    """A figure of one panel."""
    return Figure(((Block((Row((panel,)),), legend),),))


def wrapped(panels: tuple[Panel, ...], columns: int) -> tuple[Row, ...]:
    """Panels in rows of `columns` panels, the last one completed by empty places."""
    starts = range(0, len(panels), columns)
    rows = (panels[start : start + columns] for start in starts)
    return tuple(Row((*row, *([None] * (min(columns, len(panels)) - len(row))))) for row in rows)


# ------------------------------------------------------------------------------------- marks that many figures share
def ensemble(x: Array, members: Array, label: str = "learned") -> tuple[Mark, ...]:
    """The mean of members [M, P], and the range between the smallest and the largest where there are several.

    `label`: "learned" is said of functions only; solutions, of which parts are known, are the "model".
    """
    mean = Line(x, members.mean(axis=0), label)
    if len(members) == 1:
        return (mean,)
    return Band(x, members.min(axis=0), members.max(axis=0), "members"), mean


def truth(x: Array, y: Array, label: str = "truth") -> Line:
    """A reference curve: dashed and drawn over the learned curve, so that agreement is visible."""
    return Line(x, y, label, TRUTH, 1.2, "dashed", layer=4)


def true_solution(x: Array, y: Array) -> Line:
    """The solution of the true equations, which begins where the model's does: that start may be a learned one."""
    return truth(x, y, "truth, from the model's start")


def measured(x: Array, y: Array) -> Points:
    """Measurements: smaller where there are many, so that dense data stay points, and behind the curve at last."""
    if len(x) > DENSE:
        return Points(x, y, "measured", MEASURED, 1.8, alpha=0.5, layer=2)
    return Points(x, y, "measured", MEASURED, 4.2 if len(x) <= MANY else 2.6)


MANY, DENSE = 60, 400
"""Numbers of measurements in a panel from which they are drawn smaller, and behind the curve."""


def beyond(
    axis: Literal["x", "y"], shown: tuple[float, float], trained: tuple[float, float] | None
) -> tuple[Span, ...]:
    """A grey background on the parts of the range `shown` beyond the trained range; none if that is not known."""
    if trained is None:
        return ()
    (low, high), (first, last) = shown, trained
    parts = ((low, min(first, high)), (max(last, low), high))
    return tuple(Span(axis, left, right) for left, right in parts if left < right)


def extrapolated(x: Array, far: Mask) -> tuple[Span, ...]:
    """A grey background where the points `x` [P], in order, are far from all data; it ends halfway between points."""
    edges = np.concatenate([x[:1], 0.5 * (x[:-1] + x[1:]), x[-1:]])
    changes = np.flatnonzero(np.diff(np.concatenate([[0], far.astype(int), [0]])))
    return tuple(Span("x", float(edges[a]), float(edges[b])) for a, b in zip(changes[::2], changes[1::2], strict=True))


Kind = TypeVar("Kind")


def pieces(x: Array, y: Array, kinds: Sequence[Kind]) -> tuple[tuple[Kind, Array, Array], ...]:
    """A curve cut where its kind (stability) changes; neighbouring pieces share a point, so that there is no gap."""
    found, start = [], 0
    for end in range(1, len(x) + 1):
        if end == len(x) or kinds[end] != kinds[start]:
            found.append((kinds[start], x[start : end + 1], y[start : end + 1]))
            start = end
    return tuple(found)


def diagonal(low: float, high: float) -> Line:
    """The line on which learned and true values are equal."""
    ends = np.array([low, high])
    return Line(ends, ends, color=MUTED, width=0.9, layer=2)
