"""Hopf and fold curves in a plane of two parameters as a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gbspec.analysis.bifurcation.plane import PlaneCurve
from gbspec.analysis.bifurcation.plane_diagram import KINDS, PlaneDiagram
from gbspec.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FOLD = "#8e5ea2"
"""The colour of fold curves."""
MARKS: dict[str, dict[str, Any]] = {
    "bautin": {"marker": "o", "markerfacecolor": style.MEASURED},
    "bogdanov_takens": {"marker": "s", "markerfacecolor": "#c2872b"},
    "cusp": {"marker": "D", "markerfacecolor": "#4aa3b8"},
}


def plane(shown: PlaneDiagram, others: Sequence[PlaneDiagram] = (), truth: PlaneDiagram | None = None) -> Figure:
    """The curves in colour, those of `others` (members) faint behind them, the `truth` broad and grey.

    Hopf curves are solid where the cycles born there are stable (supercritical), dashed where they are not. Where both
    parameters were trained is white, what lies beyond grey.
    """
    with style.styled():
        made = style.figure(6.2, 4.6)
        axes = made.subplots()
        _beyond(axes, shown)
        for curve in truth.curves if truth is not None else ():
            values = np.array([point.values for point in curve.points])
            axes.plot(*values.T, color="#c3c7cd", linewidth=4.5, label="truth", zorder=1.5)
        for other in others:
            for curve in other.curves:
                _curve(axes, curve, {"alpha": 0.25, "linewidth": 1.0}, named=False)
        for curve in shown.curves:
            _curve(axes, curve, {"linewidth": 1.8}, named=True)
            for kind, point in curve.special:
                look = {"linestyle": "none", "markeredgecolor": "white", "markersize": 7, "zorder": 6, **MARKS[kind]}
                axes.plot(*([value] for value in point.values), label=KINDS[kind], **look)
        axes.set_xlabel(shown.parameters[0])
        axes.set_ylabel(shown.parameters[1])
        axes.set_xlim(*shown.boxes[0])
        axes.set_ylim(*shown.boxes[1])
        handles = {label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
        if handles:
            made.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 3))
        return made


def _beyond(axes: Axes, shown: PlaneDiagram) -> None:
    """Shades what lies beyond the trained ranges of the parameters."""
    for i, ((low, high), trained) in enumerate(zip(shown.boxes, shown.trained, strict=True)):
        if trained is None:
            continue
        for left, right in ((low, min(trained[0], high)), (max(trained[1], low), high)):
            if left < right:
                span = axes.axvspan if i == 0 else axes.axhspan
                span(left, right, color="#eef0f3", linewidth=0, zorder=0)


def _curve(axes: Axes, curve: PlaneCurve, look: dict[str, Any], *, named: bool) -> None:
    """A curve; of a Hopf curve cut where its criticality changes, neighbouring pieces sharing a point."""
    values = np.array([point.values for point in curve.points])
    if curve.kind == "fold":
        axes.plot(*values.T, color=FOLD, label="fold" if named else None, zorder=3, **look)
        return
    stable = [point.l1 is not None and point.l1 < 0.0 for point in curve.points]
    start = 0
    for end in range(1, len(stable) + 1):
        if end < len(stable) and stable[end] == stable[start]:
            continue
        line = "solid" if stable[start] else (0, (4, 2.2))
        label = f"Hopf, {'super' if stable[start] else 'sub'}critical" if named else None
        piece = values[start : end + 1]
        axes.plot(*piece.T, color=style.LEARNED, linestyle=line, label=label, zorder=3, **look)
        start = end
