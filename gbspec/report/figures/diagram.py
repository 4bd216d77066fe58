"""Bifurcation diagrams: branches of steady states, limit cycles and special points, one panel per state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gbspec.analysis import NAMES, Diagram
from gbspec.arrays import Array
from gbspec.report.description import (
    Axis,
    Block,
    Figure,
    Line,
    Mark,
    Marker,
    Panel,
    Points,
    beyond,
    pieces,
    wrapped,
)
from gbspec.report.style import BEHIND, CYCLE, FOLD, LEARNED, MEASURED, MEMBERS

MARKERS: dict[str, tuple[Marker, str]] = {
    "hopf": ("circle", MEASURED),
    "fold": ("square", FOLD),
    "nonsmooth_fold": ("square", MEMBERS[2]),
    "branch": ("diamond", MEMBERS[3]),
    "cycle_fold": ("up", FOLD),
    "period_doubling": ("down", MEMBERS[4]),
    "torus": ("plus", MEMBERS[5]),
}
"""The shape and colour of each kind of special point."""
ACROSS = 3
FAINT = 0.35
"""The opacity of what is far from the data."""


def figure(shown: Diagram, others: Sequence[Diagram] = (), truth: Diagram | None = None) -> Figure:
    """One panel per state: `shown` in colour, `others` (members) faint behind it, the `truth` broad and grey.

    Stable parts are solid, unstable ones dashed; cycles are drawn by their largest and smallest values. Parts far from
    the data are faint; the range in which the model was trained is white, the rest grey.
    """
    panels = tuple(_panel(shown, others, truth, state) for state in range(len(shown.states)))
    return Figure(((Block(wrapped(panels, ACROSS), "below"),),))


def _panel(shown: Diagram, others: Sequence[Diagram], truth: Diagram | None, state: int) -> Panel:
    marks: list[Mark] = [*beyond("x", (shown.low, shown.high), shown.trained)]
    if truth is not None:
        # Broad, grey and behind: dashes would look like unstable parts
        marks += [Line(x, y, "truth", BEHIND, 4.5, layer=1.5) for _, x, y, _ in _curves(truth, state)]
    for other in others:
        marks += _branches(other, state, named=False)
    marks += _branches(shown, state, named=True)
    marks += _special(shown, state)
    name, units = shown.states[state], shown.units
    x = Axis(shown.parameter, units.get(shown.parameter, ""), range=(shown.low, shown.high))
    return Panel(tuple(marks), x, Axis(name, units.get(name, "")), width=4.2, height=3.4)


def _curves(shown: Diagram, state: int) -> Iterator[tuple[str, Array, Array, tuple[tuple[bool, bool], ...]]]:
    """Each curve: its kind, parameter values, heights, and whether each point is stable, and far from the data."""
    for branch in shown.branches:
        if branch.points:
            x = np.array([point.value for point in branch.points])
            y = np.array([point.state[state] for point in branch.points])
            yield "steady", x, y, tuple((point.stable, bool(point.outside)) for point in branch.points)
    for family in shown.cycles:
        if family.cycles:
            x = np.array([cycle.value for cycle in family.cycles])
            stable = tuple((cycle.stable, bool(cycle.outside)) for cycle in family.cycles)
            yield "cycle", x, np.array([cycle.maximum[state] for cycle in family.cycles]), stable
            yield "cycle", x, np.array([cycle.minimum[state] for cycle in family.cycles]), stable


def _branches(shown: Diagram, state: int, *, named: bool) -> Iterator[Line]:
    for word, xs, ys, stability in _curves(shown, state):
        color = LEARNED if word == "steady" else CYCLE
        for (stable, far), x, y in pieces(xs, ys, stability):
            label = f"{word}, {'stable' if stable else 'unstable'}" + (", far from the data" if far else "")
            label = label if named else ""
            width, alpha = (1.8, FAINT if far else 1.0) if named else (1.0, 0.25)
            yield Line(x, y, label, color, width, "solid" if stable else "dashed", alpha)


def _special(shown: Diagram, state: int) -> Iterator[Mark]:
    for point in shown.special:
        height = float(shown.drawn_at(point)[state])
        marker, color = MARKERS[point.kind]
        if point.interval is not None:
            level = np.full(2, point.state[state])
            yield Line(np.array(point.interval), level, color=MEASURED, width=2, alpha=0.6, layer=5)
        yield Points(np.array([point.value]), np.array([height]), NAMES[point.kind], color, 7, marker, outlined=True,
                     layer=6)  # fmt: skip
