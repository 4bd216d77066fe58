"""Charts as plain plotly documents (data and layout), each from the arrays of `gbspec.report.content`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gbspec.analysis.bifurcation.diagram import NAMES, Diagram
from gbspec.analysis.bifurcation.eigen import Eigen
from gbspec.analysis.prediction.start_comparison import InitialStates
from gbspec.arrays import Array
from gbspec.report.content import ChannelFit, History, LearnedFunction, Orbit, Plane, Residuals, Slice
from gbspec.report.style import LEARNED, MEASURED, MEMBERS, MUTED, TRUTH

Chart = dict[str, Any]
Trained = tuple[float, float] | None
DIGITS = 7
"""Significant digits of numbers in a chart: more than a screen can show."""
CYCLE = "#3a8f5c"
LOGARITHMIC: Chart = {"type": "log", "exponentformat": "power", "dtick": 1}
"""An axis with powers of ten alone."""
MOST_EIGENVALUES = 400
"""Points whose eigenvalues are drawn; of more than these, evenly chosen ones: more would be one black spot."""


def numbers(values: Any) -> list[float | None]:
    """An array as JSON takes it: rounded, null (a gap) where it is not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in np.ravel(values).tolist()]


def line(
    x: Any, y: Any, label: str, color: str, *, dash: str = "solid", width: float = 2.0, legend: bool = True
) -> Chart:
    """A curve."""
    look = {"color": color, "dash": dash, "width": width}
    return {"type": "scatter", "mode": "lines", "x": numbers(x), "y": numbers(y), "name": label, "line": look,
            "showlegend": legend}  # fmt: skip


def dots(x: Any, y: Any, label: str, color: str, *, size: float = 6, legend: bool = True, **look: Any) -> Chart:
    """Points."""
    return {"type": "scattergl" if np.size(x) > 3000 else "scatter", "mode": "markers", "x": numbers(x),
            "y": numbers(y), "name": label, "marker": {"color": color, "size": size, **look},
            "showlegend": legend}  # fmt: skip


def chart(data: list[Chart], x: str, y: str, title: str = "", **layout: Any) -> Chart:
    """A document of one panel; `layout` is put over the common one."""
    several = sum(bool(one.get("showlegend", False)) for one in data) > 1
    common: Chart = {
        "showlegend": several,
        "title": {"text": title, "font": {"size": 14}, "x": 0, "xanchor": "left", "pad": {"l": 8}},
        "xaxis": {"title": {"text": x}, "zeroline": False},
        "yaxis": {"title": {"text": y}, "zeroline": False},
        "margin": {"l": 60, "r": 15, "t": 40 if title else 15, "b": 80 if several else 50},
        "legend": {"orientation": "h", "yref": "container", "y": 0, "yanchor": "bottom"},
        "hovermode": "closest",
        "height": 330,
    }
    for key, value in layout.items():
        common[key] = {**common[key], **value} if isinstance(common.get(key), dict) else value
    return {"data": data, "layout": common}


def shaded(low: float, high: float) -> Chart:
    """The range in which the model was trained, as a shape."""
    return {"type": "rect", "xref": "x", "yref": "paper", "x0": low, "x1": high, "y0": 0, "y1": 1, "layer": "below",
            "fillcolor": "#eaf1fa", "line": {"width": 0}}  # fmt: skip


def band(x: Any, members: Any) -> list[Chart]:
    """The members' mean, and their range as a shade where there are several."""
    found = [line(x, members.mean(axis=0), "learned", LEARNED)]
    if len(members) > 1:
        both = np.concatenate([members.max(axis=0), members.min(axis=0)[::-1]])
        shade = line(np.concatenate([x, x[::-1]]), both, "members", LEARNED, width=0)
        found.insert(0, {**shade, "fill": "toself", "fillcolor": "rgba(31,95,168,0.18)", "hoverinfo": "skip"})
    return found


def fit(channel: ChannelFit, time: str, *, measured: bool) -> Chart:
    """One channel, or state, of one trajectory: measurements, learned curve, truth."""
    data = band(channel.grid, channel.members)
    if channel.truth is not None:
        data.append(line(channel.grid, channel.truth, "truth", TRUTH, dash="dash", width=1.4))
    if len(channel.times):
        data.append(dots(channel.times, channel.measured, "measured", MEASURED, size=7))
    title = channel.name + ("" if measured else ": not measured")
    return chart(data, time, channel.name + (f" [{channel.unit}]" if channel.unit else ""), title)


def residuals(one: Residuals, time: str) -> Chart:
    """Residuals of a channel over time, in its standard deviations."""
    rms = float(np.sqrt(np.mean(one.residual**2))) if len(one.residual) else math.nan
    data = [dots(one.times, one.residual, "residual", LEARNED, size=4, legend=False, opacity=0.6)]
    return chart(data, time, "residual / sd", f"{one.name}: {len(one.residual)} values, rms {rms:.3g} sd", height=260)


def history(members: Sequence[History]) -> list[Chart]:
    """The loss over the seconds of training, and each constant."""
    losses, constants = [], []
    for k, member in enumerate(members):
        color = MEMBERS[k % len(MEMBERS)]
        curve = line(member.seconds, member.loss, f"member {member.member}", color, width=1.6)
        losses.append({**curve, "text": list(member.stage), "hovertemplate": "%{text}<br>%{x:.3g} s: %{y:.4g}"})
    for name in members[0].constants:
        curves = [line(m.seconds, m.constants[name], f"member {m.member}", MEMBERS[k % len(MEMBERS)], width=1.6)
                  for k, m in enumerate(members)]  # fmt: skip
        constants.append(chart(curves, "seconds", name, height=240))
    return [chart(losses, "seconds", "loss", yaxis=LOGARITHMIC), *constants]


def slice_of(name: str, piece: Slice, trained: Trained, postulate: Any = None) -> Chart:
    """A learned function along one argument, beside its truth and postulate, its trained range shaded."""
    data = band(piece.x, piece.members)
    if piece.truth is not None:
        data.append(line(piece.x, piece.truth, "truth", TRUTH, dash="dash", width=1.4))
    if postulate is not None:
        data.append(line(piece.x, postulate, "postulate", MUTED, dash="dot", width=1.6))
    title = f"{name} at {piece.label}" if piece.label else name
    shapes = [] if trained is None else [shaded(*trained)]
    return chart(data, piece.argument, name, title, shapes=shapes)


def planes(name: str, plane: Plane) -> list[Chart]:
    """Heatmaps of a learned function, and of its truth in the same colours."""
    shown = [("learned", plane.learned)] + ([("truth", plane.truth)] if plane.truth is not None else [])
    low = min(float(np.nanmin(values)) for _, values in shown)
    high = max(float(np.nanmax(values)) for _, values in shown)
    found = []
    for word, values in shown:
        data: Chart = {"type": "heatmap", "x": numbers(plane.x), "y": numbers(plane.y), "zmin": low, "zmax": high,
                       "z": [numbers(row) for row in values], "colorscale": "Viridis"}  # fmt: skip
        at = f" at {plane.label}" if plane.label else ""
        found.append(chart([data], plane.x_name, plane.y_name, f"{name}, {word}{at}"))
    return found


def parity(name: str, true: Any, learned: Any) -> Chart:
    """Learned against true values, with the line on which they would be equal."""
    ends = [float(np.min(true)), float(np.max(true))]
    data = [
        line(ends, ends, "equal", MUTED, width=1, legend=False),
        dots(true, learned, "learned", LEARNED, size=4, legend=False, opacity=0.5),
    ]
    return chart(data, f"true {name}", f"learned {name}", name)


def phase(orbits: Sequence[Orbit], x: str, y: str) -> Chart:
    """Trajectories in the plane of two states."""
    data = []
    for k, orbit in enumerate(orbits):
        data.append(line(orbit.learned[:, 0], orbit.learned[:, 1], "learned", LEARNED, width=1.6, legend=k == 0))
        data[-1]["hovertext"] = f"trajectory {orbit.label}"
        if orbit.truth is not None:
            data.append(line(orbit.truth[:, 0], orbit.truth[:, 1], "truth", TRUTH, dash="dash", width=1, legend=k == 0))
        if len(orbit.measured):
            data.append(dots(orbit.measured[:, 0], orbit.measured[:, 1], "measured", MEASURED, size=5, legend=k == 0))
    return chart(data, x, y, height=460)


def eigenvalues(found: Eigen) -> Chart:
    """Eigenvalues in the complex plane at all points."""
    data = []
    points = found.points[:: -(-len(found.points) // MOST_EIGENVALUES)]
    learned = np.concatenate([point.eigenvalues for point in points])
    data.append(dots(learned.real, learned.imag, "learned", LEARNED, size=5, opacity=0.6))
    true = [point.truth for point in points if point.truth is not None]
    if true:
        values = np.concatenate(true)
        data.append(dots(values.real, values.imag, "truth", TRUTH, size=7, opacity=0.5, symbol="circle-open"))
    every = np.concatenate([learned, *true]).real
    view = _view(every)
    left_out = int(np.sum(every < view[0])) if view else 0
    title = f"{left_out} of {len(every)} lie further left: double click" if left_out else ""
    return chart(
        data, "real part", "imaginary part", title, xaxis={"zeroline": True, **({"range": view} if view else {})}
    )


def _view(values: Array) -> list[float] | None:
    """The range of all but the lowest hundredth, where those few would press everything else together."""
    low, high = float(np.quantile(values, 0.01)), float(values.max())
    if low - values.min() < 2.0 * (high - low):
        return None
    margin = 0.1 * (high - low)
    return [low - margin, high + margin]


def initial_states(found: InitialStates) -> list[Chart]:
    """Of each mode, slowest first, how far learned and bred starts are off; one point a trajectory."""
    labels = [item.trajectory for item in found.items]
    panels = []
    for rank, rate in enumerate(found.rates):
        drawn = [("learned", LEARNED, [item.learned_off[rank] for item in found.items])]
        bred = [item.bred_off[rank] for item in found.items if item.bred_off is not None]
        drawn += [("bred", MEASURED, bred)] if bred else []
        marks = [
            {**dots(range(len(labels)), sizes, word, color), "hovertext": [f"trajectory {label}" for label in labels]}
            for word, color, sizes in drawn
        ]
        pace = f"decays in {-1 / rate:.3g}" if rate < 0 else "grows"
        panels.append(chart(marks, "trajectory", f"off {found.reference}", f"mode {rank + 1}: {pace}",
                            yaxis=LOGARITHMIC))  # fmt: skip
    return panels


def functions_parity(function: LearnedFunction) -> Chart | None:
    """Learned against true values of a function where the data are; None without a truth."""
    if function.truth is None:
        return None
    return parity(function.name, function.truth, function.members.mean(axis=0))


def diagram(shown: Diagram, truth: Diagram | None, state: int) -> Chart:
    """A bifurcation diagram in one state: stable solid, unstable dashed; the truth grey behind it."""
    data = [*(_curves(truth, state, plain=True) if truth is not None else []), *_curves(shown, state, plain=False)]
    for kind in dict.fromkeys(point.kind for point in shown.special):
        points = shown.of_kind(kind)
        heights = [shown.drawn_at(point)[state] for point in points]
        data.append(dots([point.value for point in points], heights, NAMES[kind], MEASURED, size=9))
    shapes = [] if shown.trained is None else [shaded(*shown.trained)]
    return chart(data, shown.parameter, shown.states[state], shapes=shapes, xaxis={"range": [shown.low, shown.high]},
                 height=400)  # fmt: skip


def _curves(shown: Diagram, state: int, *, plain: bool) -> list[Chart]:
    """Branches and cycles (their largest and smallest values), cut where their stability changes."""
    curves = [("steady", LEARNED, [(p.value, p.state[state], p.stable) for p in b.points]) for b in shown.branches]
    for family in shown.cycles:
        for which in ("maximum", "minimum"):
            points = [(c.value, getattr(c, which)[state], c.stable) for c in family.cycles]
            curves.append(("cycle", CYCLE, points))
    found: list[Chart] = []
    named: set[str] = set()
    for word, color, points in curves:
        start = 0
        for end in range(1, len(points) + 1):
            if end < len(points) and points[end][2] == points[start][2]:
                continue
            stable = points[start][2]
            label = "truth" if plain else f"{word}, {'stable' if stable else 'unstable'}"
            x, y, _ = zip(*points[start : end + 1], strict=True)
            dash, width = "solid" if stable else "dash", 4.5 if plain else 2.0
            shade = "#c9ccd1" if plain else color
            found.append(line(x, y, label, shade, dash=dash, width=width, legend=label not in named))
            named.add(label)
            start = end
    return found
