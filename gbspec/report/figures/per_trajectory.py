"""The constants that each trajectory has for itself: a dot and a whisker for each trajectory, a panel per constant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.report import collect
from gbspec.report.content import OwnConstant
from gbspec.report.description import Axis, Block, Figure, Line, Mark, Panel, Points, Row, Rule
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, MUTED, TRUTH


def build(source: Source) -> Figure:
    """The constants per trajectory of the run."""
    found = collect.own_constants(source.run)
    if not found:
        why = "the model has no constant `per trajectory`, or the run is of a version that did not record them"
        raise MissingError(why, "constants")
    return figure(found)


def figure(constants: Sequence[OwnConstant]) -> Figure:
    """One row per constant."""
    return Figure(((Block(tuple(Row((panel(constant),)) for constant in constants), "below"),),))


def panel(constant: OwnConstant) -> Panel:
    """Values and 90 % intervals over the trajectories in the order of the table, with their mean."""
    at = np.arange(1.0, len(constant.labels) + 1)
    gaps = np.full(len(at), np.nan)
    marks: list[Mark] = [
        Line(np.column_stack([at, at, gaps]).ravel(), np.column_stack([constant.low, constant.high, gaps]).ravel(),
             "interval", width=1.6, alpha=0.55, layer=2),
        Points(at, constant.values, "learned", LEARNED, 5, hover=constant.labels),
        Rule("y", float(constant.values.mean()), "mean", MUTED, 0.9, "dotted"),
    ]  # fmt: skip
    if constant.truth is not None:
        marks.append(Rule("y", constant.truth, "truth", TRUTH, 1.2, "dashed"))
    x = Axis("trajectory, in the order of the table", margin=0.03)
    return Panel(tuple(marks), x, Axis(constant.name, constant.unit, margin=0.08), width=5.6, height=2.2)
