"""Panels of figures as plain plotly documents (data and layout)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias, assert_never

import numpy as np
from numpy.typing import ArrayLike

from gbspec.json_values import JsonObject
from gbspec.report.description import Axis, Band, Bars, Heat, Line, Mark, Panel, Points, Rug, Rule, Span, Text

Chart: TypeAlias = JsonObject
DIGITS = 7
"""Significant digits of numbers in a chart: more than a screen can show."""
PIXELS = 1.25
"""Pixels per point for the widths of lines."""
SIZE = 1.6
"""Pixels per point for the sizes of marks; larger, since a page is viewed from further away."""
DASHES = {"solid": "solid", "dashed": "dash", "dotted": "dot"}
MARKERS = {"circle": "circle", "square": "square", "diamond": "diamond", "up": "triangle-up", "down": "triangle-down",
           "plus": "cross", "cross": "x-thin-open", "bar": "line-ns-open"}  # fmt: skip
TICK = 0.03
"""The length of a rug's ticks, as a share of the panel's height."""
MOST_IN_SVG = 3000
"""Number of points from which the browser draws them by the graphics card."""


def numbers(values: ArrayLike) -> list[float | None]:
    """An array as a list for JSON: rounded, null (a gap) where it is not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in np.ravel(np.asarray(values)).tolist()]


def chart(panel: Panel) -> Chart:
    """A panel as a separate document."""
    data: list[Chart] = []
    layout = _layout(panel)
    for mark in panel.marks:
        _draw(mark, data, layout)
    labels: set[str] = set()
    for entry in (*data, *layout["shapes"]):
        label = entry["name"] if entry.get("showlegend") else ""
        entry["showlegend"] = bool(label) and label not in labels
        labels.add(label)
    several = len(labels - {""}) > 1
    layout["showlegend"] = several
    layout["margin"]["b"] = 80 if several else 50
    if any(isinstance(mark, Text) for mark in panel.marks):
        layout["margin"]["t"] += 15
    return {"data": data, "layout": layout}


def _layout(panel: Panel) -> Chart:
    return {
        "title": {"text": panel.title, "font": {"size": 14}, "x": 0, "xanchor": "left", "pad": {"l": 8}},
        "xaxis": _axis(panel.x),
        "yaxis": _axis(panel.y),
        "margin": {"l": 60, "r": 15, "t": 40 if panel.title else 15},
        "legend": {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom"},
        "hovermode": "closest",
        "height": round(65 + 95 * panel.height),
        "shapes": [],
        "annotations": [],
    }


def _axis(axis: Axis) -> Chart:
    made: Chart = {"title": {"text": axis.title}, "zeroline": False}
    if axis.log:
        made |= {"type": "log", "exponentformat": "power", "dtick": 1}
    if axis.range is not None:
        made["range"] = [math.log10(end) if axis.log else end for end in axis.range]
    if not axis.shown:
        made |= {"showticklabels": False, "showgrid": False}
    return made


def _draw(mark: Mark, data: list[Chart], layout: Chart) -> None:
    match mark:
        case Line():
            look = {"color": mark.color, "dash": DASHES[mark.dash], "width": round(PIXELS * mark.width, 2)}
            data.append(_trace("lines", mark.x, mark.y, mark.label, mark.hover) | {"line": look, "opacity": mark.alpha})
        case Points():
            data.append(_points(mark))
        case Band():
            x, y = np.concatenate([mark.x, mark.x[::-1]]), np.concatenate([mark.high, mark.low[::-1]])
            look = {"line": {"width": 0}, "fill": "toself", "fillcolor": _clear(mark.color, mark.alpha)}
            data.append(_trace("lines", x, y, mark.label) | look | {"hoverinfo": "skip"})
        case Span():
            layout["shapes"].append(_shape("rect", mark.axis, mark.low, mark.high, mark.label) | {
                "layer": "below", "fillcolor": _clear(mark.color, mark.alpha), "line": {"width": 0}})  # fmt: skip
        case Rule():
            look = {"color": mark.color, "dash": DASHES[mark.dash], "width": round(PIXELS * mark.width, 2)}
            layout["shapes"].append(_shape("line", mark.axis, mark.value, mark.value, mark.label) | {"line": look})
        case Rug():
            path = "".join(f"M{x:.{DIGITS}g},0L{x:.{DIGITS}g},{TICK}" for x in mark.x.tolist())
            layout["shapes"].append({"type": "path", "xref": "x", "yref": "paper", "path": path, "opacity": 0.5,
                                     "line": {"color": mark.color, "width": 1}})  # fmt: skip
        case Heat():
            data.append({"type": "heatmap", "x": numbers(mark.x), "y": numbers(mark.y), "zmin": mark.low,
                         "zmax": mark.high, "z": [numbers(row) for row in mark.values],
                         "colorscale": "Viridis"})  # fmt: skip
        case Bars():
            middles = (mark.edges[:-1] + mark.edges[1:]) / 2
            data.append({"type": "bar", "orientation": "h", "x": numbers(mark.counts), "y": numbers(middles),
                         "width": numbers(np.diff(mark.edges)), "marker": {"color": mark.color}})  # fmt: skip
        case Text():
            place = {"xref": "x", "yref": "paper", "y": 1, "xanchor": "center", "yanchor": "bottom"}
            layout["annotations"].append({"x": mark.x, "text": mark.text, "showarrow": False, **place})
        case _:
            assert_never(mark)


def _trace(mode: str, x: ArrayLike, y: ArrayLike, label: str, hover: Sequence[str] = ()) -> Chart:
    made: Chart = {"type": "scatter", "mode": mode, "x": numbers(x), "y": numbers(y), "name": label,
                   "showlegend": bool(label)}  # fmt: skip
    return made | ({"hovertext": list(hover)} if hover else {}) | ({} if label or hover else {"hoverinfo": "x+y"})


def _points(mark: Points) -> Chart:
    look: Chart = {"color": mark.color, "size": round(SIZE * mark.size, 1), "opacity": mark.alpha,
                   "symbol": MARKERS[mark.marker]}  # fmt: skip
    if mark.hollow:
        look["symbol"] += "-open"
    made = _trace("markers", mark.x, mark.y, mark.label, mark.hover) | {"marker": look}
    return made | ({"type": "scattergl"} if len(mark.x) > MOST_IN_SVG else {})


def _shape(kind: str, axis: str, low: float, high: float, label: str) -> Chart:
    along, across = ("x", "y") if axis == "x" else ("y", "x")
    return {"type": kind, f"{along}ref": along, f"{across}ref": "paper", f"{along}0": low, f"{along}1": high,
            f"{across}0": 0, f"{across}1": 1, "name": label, "showlegend": bool(label)}  # fmt: skip


def _clear(color: str, alpha: float) -> str:
    """The colour `#rrggbb` with the opacity `alpha`."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"
