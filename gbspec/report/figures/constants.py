"""The learned constants, each on its own axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.report import collect
from gbspec.report.content import LearnedConstant
from gbspec.report.description import Axis, Block, Figure, Line, Mark, Panel, Points, Row, Rule
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, MEASURED, MUTED, TRUTH


def build(source: Source) -> Figure:
    """The constants of the run."""
    found = collect.constants(source.run)
    if not found:
        raise MissingError("the model has no learned constant", "functions")
    return figure(found)


def figure(learned: Sequence[LearnedConstant]) -> Figure:
    """One row per constant."""
    return Figure(((Block(tuple(Row((panel(constant),)) for constant in learned), "below"),),))


def panel(constant: LearnedConstant, *, height: float = 0.95) -> Panel:
    """Value, interval, members, starting value and truth of a constant on a horizontal axis."""
    marks: list[Mark] = []
    if constant.interval is not None:
        marks.append(Line(np.array(constant.interval), np.zeros(2), "interval", width=4.0, alpha=0.35, layer=2))
    if constant.profile is not None and all(end is not None for end in constant.profile.interval):
        ends = np.array(constant.profile.interval, dtype=np.float64)
        marks.append(Line(ends, np.full(2, -0.5), "profile", MEASURED, 2.0, layer=2))
    if len(constant.members) > 1:
        at = np.zeros(len(constant.members))
        marks.append(Points(np.array(constant.members), at, "members", LEARNED, 11, "bar", layer=3))
    marks.append(Points(np.array([constant.value]), np.zeros(1), "learned", LEARNED, 6))
    if constant.truth is not None:
        marks.append(Rule("x", constant.truth, "truth", TRUTH, 1.2, "dashed"))
    if constant.start is not None:
        marks.append(Points(np.array([constant.start]), np.zeros(1), "start", MUTED, 6, "cross", layer=3))
    said = f"{constant.name} = {constant.value:.5g}"
    if constant.truth:
        said += f", {100 * abs(constant.value / constant.truth - 1):.2g} % from the truth"
    return Panel(
        tuple(marks),
        Axis(constant.name if constant.unit else "", constant.unit, margin=0.08),
        Axis(range=(-1.0, 1.0), shown=False),
        said,
        width=5.6,
        height=height,
    )
