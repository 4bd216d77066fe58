"""Panels of figures as plain plotly documents (data and layout).

Only traces of plotly's basic build (scatter, bar) are used, which is a quarter of the whole script.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias, assert_never

import numpy as np
from numpy.typing import ArrayLike

from gbspec.arrays import Array
from gbspec.json_values import JsonObject
from gbspec.report.description import Axis, Band, Bars, Heat, Line, Mark, Panel, Points, Rug, Rule, Span, Text

Chart: TypeAlias = JsonObject
STEPS = 1e5
"""Numbers are rounded to this part of their range: finer than a screen shows, also where it is enlarged."""
DIGITS = 7
"""Significant digits of single numbers."""
ORDERS = 1e3
"""The ratio of the largest to the smallest positive number from which each is rounded by itself."""
PIXELS = 1.25
"""Pixels per point for the widths of lines."""
SIZE = 1.6
"""Pixels per point for the sizes of marks; larger, since a page is viewed from further away."""
DASHES = {"solid": "solid", "dashed": "dash", "dotted": "dot"}
MARKERS = {"circle": "circle", "square": "square", "diamond": "diamond", "up": "triangle-up", "down": "triangle-down",
           "plus": "cross", "cross": "x-thin-open", "bar": "line-ns-open"}  # fmt: skip
TICK = 0.03
"""The length of a rug's ticks, as a share of the panel's height."""
MOST = 6000
"""Points of a mark; of more, evenly spaced ones are drawn."""
NAMES = 24
"""Names of places on an axis."""
EVEN = 8
"""Number of points from which evenly spaced ones are written as their first and their distance."""
TOP, BOTTOM, BELOW_LEGEND = 15, 50, 80
"""Pixels above and below the axes, without a title and without or with a legend."""
INCH = 95
"""Pixels per inch of a panel's height."""
GAP, TITLE = 16, 25
"""Pixels between panels that share an axis, and those that a title takes."""


def numbers(values: ArrayLike) -> list[float | None]:
    """An array as a list for JSON: rounded relative to its range, null (a gap) where it is not finite.

    Positive numbers of several orders of magnitude, such as losses, are each rounded relative to themselves: they may
    be drawn on a logarithmic axis, where what is rounded to zero has no place.
    """
    array = np.ravel(np.asarray(values, dtype=np.float64))
    finite = array[np.isfinite(array)]
    span = float(np.ptp(finite)) if len(finite) else 0.0
    orders = len(finite) > 0 and 0 < float(finite.min()) * ORDERS < float(finite.max())
    if orders or span <= 0 or not math.isfinite(span):
        return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in array.tolist()]
    digits = math.ceil(math.log10(STEPS / span))
    return [round(v, digits) if math.isfinite(v) else None for v in array.tolist()]


def chart(panel: Panel) -> Chart:
    """A panel as a separate document."""
    return stack((panel,))


def stack(panels: Sequence[Panel]) -> Chart:
    """Panels below each other over one x axis, that of the last one, as one document."""
    drawing = _Drawing()
    for k, panel in enumerate(panels):
        drawing.panel(panel, k)
    data, layout = drawing.data, drawing.layout
    labels: set[str] = set()
    for entry in (*data, *layout["shapes"]):
        label = entry["name"] if entry.get("showlegend") else ""
        entry["showlegend"] = bool(label) and label not in labels
        if label:
            entry["legendgroup"] = label
        labels.add(label)
    several = len(labels - {""}) > 1
    layout["showlegend"] = several
    layout["xaxis"] = _axis(panels[-1].x) | {"anchor": _place("y", len(panels) - 1)}
    top = TOP + (TITLE if panels[0].title else 0)
    if any(isinstance(mark, Text) for mark in panels[0].marks):
        top += 30  # below the buttons
    layout["margin"] |= {"t": top, "b": BELOW_LEGEND if several else BOTTOM}
    _heights(panels, layout)
    return {"data": data, "layout": layout}


def _heights(panels: Sequence[Panel], layout: Chart) -> None:
    """The part of the height that each panel takes, and the height of the whole."""
    heights = [round(INCH * panel.height) for panel in panels]
    gaps = [GAP + (TITLE if panel.title else 0) for panel in panels[1:]]
    whole = sum(heights) + sum(gaps)
    edge = float(whole)
    for k, (height, gap) in enumerate(zip(heights, [0, *gaps], strict=True)):
        edge -= gap
        layout[f"yaxis{k + 1 if k else ''}"]["domain"] = [max(0.0, (edge - height) / whole), edge / whole]
        edge -= height
    layout["height"] = whole + layout["margin"]["t"] + layout["margin"]["b"]


def _place(letter: str, k: int) -> str:
    """The name of an axis in a trace: `y`, `y2`, `y3`."""
    return f"{letter}{k + 1}" if k else letter


@dataclass
class _Drawing:
    """A document while panels are added."""

    data: list[Chart] = field(default_factory=list)
    layout: Chart = field(default_factory=lambda: _layout())

    def panel(self, panel: Panel, k: int) -> None:
        """Adds the k-th panel from above."""
        axis = _axis(panel.y)
        self.layout[f"yaxis{k + 1 if k else ''}"] = axis
        before = len(self.data)
        for mark in panel.marks:
            _draw(mark, self.data, self.layout, k)
        for trace in self.data[before:]:
            trace |= {"yaxis": _place("y", k)} if k else {}
        if panel.title:
            self.layout["annotations"].append({
                "text": panel.title, "showarrow": False, "font": {"size": 14}, "align": "left",
                "xref": "paper", "x": 0, "xanchor": "left", "yref": f"{_place('y', k)} domain", "y": 1,
                "yanchor": "bottom", "yshift": 4})  # fmt: skip


def _layout() -> Chart:
    return {
        "margin": {"l": 62, "r": 15},
        "legend": {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom"},
        "hovermode": "closest",
        "shapes": [],
        "annotations": [],
        "images": [],
    }


def _axis(axis: Axis) -> Chart:
    made: Chart = {"title": {"text": axis.title, "standoff": 8}, "zeroline": False}
    if axis.log:
        made |= {"type": "log", "exponentformat": "power", "dtick": 1}
    if axis.range is not None:
        made["range"] = [math.log10(end) if axis.log else end for end in axis.range]
    if axis.names:
        shown = axis.ticks(NAMES)
        made |= {"tickvals": [place for place, _ in shown], "ticktext": [name for _, name in shown]}
    if not axis.shown:
        made |= {"showticklabels": False, "showgrid": False}
    return made


def _draw(mark: Mark, data: list[Chart], layout: Chart, k: int) -> None:
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
            layout["shapes"].append(_shape("rect", mark.axis, mark.low, mark.high, mark.label, k) | {
                "layer": "below", "fillcolor": _clear(mark.color, mark.alpha), "line": {"width": 0}})  # fmt: skip
        case Rule():
            look = {"color": mark.color, "dash": DASHES[mark.dash], "width": round(PIXELS * mark.width, 2)}
            layout["shapes"].append(_shape("line", mark.axis, mark.value, mark.value, mark.label, k) | {"line": look})
        case Rug():
            path = "".join(f"M{x:.{DIGITS}g},0L{x:.{DIGITS}g},{TICK}" for x in mark.x.tolist())
            layout["shapes"].append({"type": "path", "xref": "x", "yref": f"{_place('y', k)} domain", "path": path,
                                     "opacity": 0.5, "line": {"color": mark.color, "width": 1}})  # fmt: skip
        case Heat():
            layout["images"].append(_image(mark, k))
            data.append(_colours(mark))
        case Bars():
            middles = (mark.edges[:-1] + mark.edges[1:]) / 2
            data.append({"type": "bar", "orientation": "h", "x": numbers(mark.counts), "y": numbers(middles),
                         "width": numbers(np.diff(mark.edges)), "marker": {"color": mark.color}})  # fmt: skip
        case Text():
            place = {"xref": "x", "yref": f"{_place('y', k)} domain", "y": 1, "xanchor": "center", "yanchor": "bottom"}
            layout["annotations"].append({"x": mark.x, "text": mark.text, "showarrow": False, **place})
        case _:
            assert_never(mark)


def _image(mark: Heat, k: int) -> Chart:
    """The colours of a grid as an image, since the basic build has no heat map."""
    from matplotlib.image import imsave

    written = io.BytesIO()
    imsave(written, mark.values, vmin=mark.low, vmax=mark.high, cmap="viridis", origin="lower", format="png")
    source = "data:image/png;base64," + base64.b64encode(written.getvalue()).decode("ascii")
    (left, right), (low, high) = (_edges(axis) for axis in (mark.x, mark.y))
    return {"source": source, "xref": "x", "yref": _place("y", k), "x": left, "y": high, "sizex": right - left,
            "sizey": high - low, "sizing": "stretch", "layer": "below"}  # fmt: skip


def _edges(middles: ArrayLike) -> tuple[float, float]:
    """The outer edges of evenly spaced cells."""
    at = np.asarray(middles, dtype=np.float64)
    half = 0.5 * (at[-1] - at[0]) / max(1, len(at) - 1)
    return float(at[0] - half), float(at[-1] + half)


def _colours(mark: Heat) -> Chart:
    """Two invisible points at the corners, which give the axes their range, and the scale of colours."""
    (left, right), (low, high) = (_edges(axis) for axis in (mark.x, mark.y))
    scale = {"color": [mark.low, mark.high], "colorscale": "Viridis", "showscale": True, "size": 1, "opacity": 0,
             "cmin": mark.low, "cmax": mark.high, "colorbar": {"thickness": 14}}  # fmt: skip
    return {"type": "scatter", "mode": "markers", "x": [left, right], "y": [low, high], "marker": scale,
            "hoverinfo": "skip", "showlegend": False, "cliponaxis": True}  # fmt: skip


def _trace(mode: str, x: ArrayLike, y: ArrayLike, label: str, hover: Sequence[str] = ()) -> Chart:
    made: Chart = {"type": "scatter", "mode": mode, **_along(np.ravel(np.asarray(x, dtype=np.float64))),
                   "y": numbers(y), "name": label, "showlegend": bool(label)}  # fmt: skip
    return made | ({"hovertext": list(hover)} if hover else {}) | ({} if label or hover else {"hoverinfo": "x+y"})


def _along(x: Array) -> Chart:
    """The values on the x axis; evenly spaced ones by their first and their distance."""
    if len(x) >= EVEN and np.isfinite(x).all() and np.ptp(x) > 0:
        distance = (x[-1] - x[0]) / (len(x) - 1)
        if np.abs(x - (x[0] + distance * np.arange(len(x)))).max() < 1e-6 * abs(distance):
            return {"x0": float(x[0]), "dx": float(distance)}
    return {"x": numbers(x)}


def _points(mark: Points) -> Chart:
    look: Chart = {"color": mark.color, "size": round(SIZE * mark.size, 1), "opacity": mark.alpha,
                   "symbol": MARKERS[mark.marker]}  # fmt: skip
    if mark.hollow:
        look["symbol"] += "-open"
    every = max(1, math.ceil(len(mark.x) / MOST))
    hover = mark.hover[::every]
    return _trace("markers", mark.x[::every], mark.y[::every], mark.label, hover) | {"marker": look}


def _shape(kind: str, axis: str, low: float, high: float, label: str, k: int) -> Chart:
    along, across = ("x", _place("y", k)) if axis == "x" else (_place("y", k), "x")
    one, other = ("x", "y") if axis == "x" else ("y", "x")
    return {"type": kind, f"{one}ref": along, f"{other}ref": f"{across} domain", f"{one}0": low, f"{one}1": high,
            f"{other}0": 0, f"{other}1": 1, "name": label, "showlegend": bool(label)}  # fmt: skip


def _clear(color: str, alpha: float) -> str:
    """The colour `#rrggbb` with the opacity `alpha`."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"
