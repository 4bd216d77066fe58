"""Hopf and fold curves in a plane of two parameters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from gbspec.analysis import KINDS, PlaneCurve, PlaneDiagram
from gbspec.report.description import Axis, Figure, Line, Mark, Marker, Panel, Points, beyond, pieces, single
from gbspec.report.style import BEHIND, FOLD, LEARNED, MEASURED, MEMBERS

MARKERS: dict[str, tuple[Marker, str]] = {
    "bautin": ("circle", MEASURED),
    "bogdanov_takens": ("square", MEMBERS[3]),
    "cusp": ("diamond", MEMBERS[4]),
}
"""The shape and colour of each kind of special point."""


def figure(shown: PlaneDiagram, others: Sequence[PlaneDiagram] = (), truth: PlaneDiagram | None = None) -> Figure:
    """The curves in colour, those of `others` (members) faint behind them, the `truth` broad and grey.

    Hopf curves are solid where the cycles born there are stable (supercritical), dashed where they are not. The region
    of the training is white, the rest grey.
    """
    marks: list[Mark] = [*beyond("x", shown.boxes[0], shown.trained[0]), *beyond("y", shown.boxes[1], shown.trained[1])]
    for curve in truth.curves if truth is not None else ():
        x, y = np.array([point.values for point in curve.points]).T
        marks.append(Line(x, y, "truth", BEHIND, 4.5, layer=1.5))
    for other in others:
        for curve in other.curves:
            marks += _curve(curve, named=False)
    for curve in shown.curves:
        marks += _curve(curve, named=True)
        for kind, point in curve.special:
            marker, color = MARKERS[kind]
            x, y = (np.array([value]) for value in point.values)
            marks.append(Points(x, y, KINDS[kind], color, 7, marker, outlined=True, layer=6))
    x_axis, y_axis = (Axis(name, range=box) for name, box in zip(shown.parameters, shown.boxes, strict=True))
    return single(Panel(tuple(marks), x_axis, y_axis, width=6.2, height=4.2), "below")


def _curve(curve: PlaneCurve, *, named: bool) -> Iterator[Line]:
    """A curve; a Hopf curve is cut where its criticality changes."""
    xs, ys = np.array([point.values for point in curve.points]).T
    width, alpha = (1.8, 1.0) if named else (1.0, 0.25)
    if curve.kind == "fold":
        yield Line(xs, ys, "fold" if named else "", FOLD, width, alpha=alpha)
        return
    stability = tuple(point.l1 is not None and point.l1 < 0.0 for point in curve.points)
    for stable, x, y in pieces(xs, ys, stability):
        label = f"Hopf, {'super' if stable else 'sub'}critical" if named else ""
        yield Line(x, y, label, LEARNED, width, "solid" if stable else "dashed", alpha)
