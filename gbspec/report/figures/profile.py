"""The profile likelihood of a constant."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.report.description import Axis, Block, Figure, Line, Mark, Panel, Points, Row, Rule, Span
from gbspec.report.style import LEARNED, MEASURED, TRUTH
from gbspec.training import Profile


def figure(found: Profile, truth: float | None = None) -> Figure:
    """Deviance over the constant's value with the 90 % threshold and interval; below it the other constants."""
    names = list(found.points[0].others) if found.points else []
    x = Axis(found.name)
    values = np.array([point.value for point in found.points])
    others = [
        Panel(_followed(values, np.array([p.others[name] for p in found.points]), "", 3.0), x, Axis(name), width=5.6,
              height=1.2)
        for name in names
    ]  # fmt: skip
    rows = tuple(Row((panel,)) for panel in (_deviance(found, truth, values, x), *others))
    return Figure(((Block(rows, "below", "column"),),))


def _deviance(found: Profile, truth: float | None, values: Array, x: Axis) -> Panel:
    marks: list[Mark] = []
    if found.settled and len(values):
        low, high = (end if end is not None else float(values[k]) for end, k in ((found.low, 0), (found.high, -1)))
        marks.append(Span("x", low, high, "interval", LEARNED, 0.1))
    if found.fitted is not None:
        marks.append(
            Line(np.array(found.fitted), np.zeros(2), "interval of the fit", LEARNED, 4.0, alpha=0.35, layer=2)
        )
    marks.append(Rule("y", found.threshold, "90 %", MEASURED, 1.2))
    marks += _followed(values, np.array([point.deviance for point in found.points]), "deviance", 4.0)
    slow = [p for p in found.points if not p.converged]
    if slow:
        at, deviance = np.array([p.value for p in slow]), np.array([p.deviance for p in slow])
        marks.append(Points(at, deviance, "not converged", LEARNED, 5, hollow=True))
    if truth is not None:
        marks.append(Rule("x", truth, "truth", TRUTH, 1.2, "dashed"))
    ends = [f"{end:.5g}" if end is not None else "open" for end in (found.low, found.high)]
    interval = f"90 %: {ends[0]} to {ends[1]}" if found.settled else "not all fits converged"
    y = Axis("deviance", range=(-0.2, max(2.2 * found.threshold, 1.0)))
    return Panel(tuple(marks), x, y, f"{found.name} = {found.estimate:.5g}, {interval}", width=5.6, height=3.0)


def _followed(x: Array, y: Array, label: str, size: float) -> tuple[Mark, ...]:
    """A curve with points where it was computed."""
    return Line(x, y, label), Points(x, y, size=size, layer=4)
