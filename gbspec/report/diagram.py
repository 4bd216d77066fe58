"""Bifurcation diagrams as figures: branches of steady states, limit cycles, special points, one panel a state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.arrays import Array
from gbspec.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CYCLE = "#3a8f5c"
"""The colour of limit cycles."""
MARKS: dict[str, dict[str, Any]] = {
    "hopf": {"marker": "o", "markerfacecolor": style.MEASURED, "label": "Hopf point"},
    "fold": {"marker": "s", "markerfacecolor": "#8e5ea2", "label": "fold"},
    "branch": {"marker": "D", "markerfacecolor": "#c2872b", "label": "branch point"},
    "cycle_fold": {"marker": "^", "markerfacecolor": "#8e5ea2", "label": "fold of cycles"},
    "period_doubling": {"marker": "v", "markerfacecolor": "#4aa3b8", "label": "period doubling"},
    "torus": {"marker": "P", "markerfacecolor": "#b14a5b", "label": "torus bifurcation"},
}
ACROSS = 3


def diagram(shown: Diagram, others: Sequence[Diagram] = (), truth: Diagram | None = None) -> Figure:
    """One panel a state: `shown` in colour, `others` (members) faint behind it, the `truth` broad and grey.

    Stable parts are solid, unstable ones dashed; of a cycle its largest and smallest values are drawn. The range in
    which the model was trained is white, what lies beyond it grey.
    """
    with style.styled():
        count = len(shown.states)
        columns = min(ACROSS, count)
        made = style.figure(max(4.2 * columns, 5.4), 3.4 * -(-count // columns) + 0.4)
        panels = list(made.subplots(-(-count // columns), columns, squeeze=False).ravel())
        for i, axes in enumerate(panels):
            if i >= count:
                axes.set_axis_off()
                continue
            _beyond(axes, shown)
            for other in others:
                _branches(axes, other, i, {"alpha": 0.25, "linewidth": 1.0}, named=False)
            _branches(axes, shown, i, {"linewidth": 1.8}, named=True)
            if truth is not None:
                _truth(axes, truth, i)
            _special(axes, shown, i)
            axes.set_xlabel(shown.parameter)
            axes.set_ylabel(shown.states[i])
            axes.set_xlim(shown.low, shown.high)
        handles: dict[str, Any] = {}
        for axes in panels[:count]:
            handles.update({label: handle for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)})
        made.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(len(handles), 5))
        return made


def _beyond(axes: Axes, shown: Diagram) -> None:
    """Shades what lies beyond the trained range of the parameter."""
    if shown.trained is None:
        return
    low, high = shown.trained
    for left, right in ((shown.low, min(low, shown.high)), (max(high, shown.low), shown.high)):
        if left < right:
            axes.axvspan(left, right, color="#eef0f3", linewidth=0, zorder=0)


def _branches(axes: Axes, shown: Diagram, state: int, look: dict[str, Any], *, named: bool) -> None:
    for branch in shown.branches:
        values = np.array([point.value for point in branch.points])
        heights = np.array([point.state[state] for point in branch.points])
        _pieces(axes, values, heights, [p.stable for p in branch.points], style.LEARNED, look, "steady", named)
    for family in shown.cycles:
        values = np.array([cycle.value for cycle in family.cycles])
        stable = [cycle.stable for cycle in family.cycles]
        for heights in (
            np.array([cycle.maximum[state] for cycle in family.cycles]),
            np.array([cycle.minimum[state] for cycle in family.cycles]),
        ):
            _pieces(axes, values, heights, stable, CYCLE, look, "cycle", named)


def _pieces(
    axes: Axes,
    values: Array,
    heights: Array,
    stable: Sequence[bool],
    color: str,
    look: dict[str, Any],
    word: str,
    named: bool,
) -> None:
    """A curve cut where its stability changes; neighbouring pieces share a point, so that no gap is seen."""
    start = 0
    for end in range(1, len(values) + 1):
        if end < len(values) and stable[end] == stable[start]:
            continue
        line = "solid" if stable[start] else (0, (4, 2.2))
        label = f"{word}, {'stable' if stable[start] else 'unstable'}" if named else None
        stop = min(end + 1, len(values))
        axes.plot(values[start:stop], heights[start:stop], color=color, linestyle=line, label=label, zorder=3, **look)
        start = end


def _truth(axes: Axes, truth: Diagram, state: int) -> None:
    curves = [[(p.value, p.state[state]) for p in branch.points] for branch in truth.branches]
    for family in truth.cycles:
        curves.append([(cycle.value, cycle.maximum[state]) for cycle in family.cycles])
        curves.append([(cycle.value, cycle.minimum[state]) for cycle in family.cycles])
    for curve in curves:
        if curve:
            values, heights = zip(*curve, strict=True)
            # Broad, grey and behind: dashes would be taken for what is unstable
            axes.plot(values, heights, color="#c3c7cd", linewidth=4.5, label="truth", zorder=1.5)


def _special(axes: Axes, shown: Diagram, state: int) -> None:
    for point in shown.special:
        mark = MARKS.get(point.kind)
        if mark is None:
            continue
        look = {"linestyle": "none", "markeredgecolor": "white", "markersize": 7, "zorder": 6, **mark}
        axes.plot([point.value], [shown.drawn_at(point)[state]], **look)
        if point.interval is not None:
            axes.plot(point.interval, [point.state[state]] * 2, color=style.MEASURED, linewidth=2, alpha=0.6, zorder=5)
