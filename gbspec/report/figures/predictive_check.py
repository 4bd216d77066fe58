"""A visual predictive check: quantiles of the data over time, within those of simulated populations."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.report.collect import channel_unit, population_tables
from gbspec.report.description import Axis, Band, Block, Dash, Figure, Line, Mark, Panel, Points, Row
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, MEASURED, MUTED

MEASURED_AS: tuple[tuple[str, Dash], ...] = (
    ("measured 5 %, 95 %", "dashed"),
    ("measured 50 %", "solid"),
    ("", "dashed"),
)
"""How the quantiles of the table are labelled and drawn, in its order."""


def build(source: Source) -> Figure:
    """One row per channel."""
    found = population_tables(source.run)
    if found is None or not len(found.arrays["check"]):
        raise MissingError("the run has no population, whose spread could be checked", "fit")
    model, check, tables = source.run.model, found.arrays["check"], found.arrays
    axis = Axis(model.time.name, model.time.unit or "", margin=0.03)
    rows = []
    for index, channel in enumerate(model.channels):
        here, seen = check[check[:, 0] == index], tables["channel"] == index
        if len(here):
            given = Axis(channel.name, channel_unit(model, channel), margin=0.05)
            points = tables["time"][seen], tables["value"][seen]
            rows.append(Row((Panel(_marks(here, *points), axis, given, width=6.2, height=3.0),)))
    return Figure(((Block(tuple(rows), "below"),),))


def _marks(check: Array, times: Array, values: Array) -> tuple[Mark, ...]:
    """Bands of simulated quantiles as steps over the intervals of time, and lines of measured ones."""
    edges = np.column_stack([check[:, 1], check[:, 3]]).ravel()
    marks: list[Mark] = [Points(times, values, "", MEASURED, 2.6, alpha=0.35, layer=2)]
    for k in range(len(MEASURED_AS)):
        low, high = (np.repeat(check[:, 7 + 3 * k + side], 2) for side in (0, 2))
        colour, label = (LEARNED, "simulated 50 %") if k == 1 else (MUTED, "simulated 5 %, 95 %" if k == 0 else "")
        marks.append(Band(edges, low, high, label, colour, 0.25))
        marks.append(Line(check[:, 2], check[:, 4 + k], MEASURED_AS[k][0], MEASURED, 1.5, MEASURED_AS[k][1]))
    return tuple(marks)
