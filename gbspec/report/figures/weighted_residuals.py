"""Conditional weighted residuals of a population over time and prediction, and its predictions against measurements."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbspec.arrays import Array
from gbspec.report.collect import channel_unit, population_tables
from gbspec.report.description import Axis, Block, Figure, Line, Panel, Points, Row, Rule
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, MUTED


def build(source: Source) -> Figure:
    """One row per channel."""
    found = population_tables(source.run)
    if found is None:
        raise MissingError("the run has no population, whose residuals could be weighted", "residuals")
    model = source.run.model
    time = Axis(model.time.name, model.time.unit or "", margin=0.03)
    rows = []
    for index, channel in enumerate(model.channels):
        here = found.arrays["channel"] == index
        if here.any():
            part = {name: found.arrays[name][here] for name in ("time", "population", "individual", "value", "cwres")}
            names = tuple(found.labels[int(i)] for i in found.arrays["owner"][here])
            rows.append(_row(channel.name, channel_unit(model, channel), time, part, names))
    return Figure(((Block(tuple(rows), "below"),),))


def _row(name: str, unit: str, time: Axis, part: Mapping[str, Array], labels: tuple[str, ...]) -> Row:
    y, predicted = Axis("weighted residual"), Axis(f"{name}, predicted for the population", unit, margin=0.04)
    known = part["cwres"][np.isfinite(part["cwres"])]
    sd = float(np.std(known)) if len(known) else float("nan")
    panels = [
        Panel(
            (Rule("y", 0.0), Rule("y", 1.96, dash="dotted"), Rule("y", -1.96, dash="dotted"),
             Points(x, part["cwres"], "", LEARNED, 3.0, alpha=0.6, layer=3, hover=labels)),
            axis, y, title, width=3.4, height=2.5,
        )
        for x, axis, title in (
            (part["time"], time, f"{name}: sd {sd:.2f}"),
            (part["population"], predicted, " "),
        )
    ]  # fmt: skip
    both = np.concatenate([part["value"], part["individual"]])
    ends = np.array([np.nanmin(both), np.nanmax(both)]) if len(both) else np.array([0.0, 1.0])
    compared = Panel(
        (
            Line(ends, ends, "", MUTED, 1.0, "dashed"),
            Points(part["population"], part["value"], "population", MUTED, 3.0, alpha=0.6, layer=2, hover=labels),
            Points(part["individual"], part["value"], "own constants", LEARNED, 3.0, alpha=0.8, layer=3, hover=labels),
        ),
        Axis(f"predicted {name}", unit, margin=0.04),
        Axis(f"measured {name}", unit, margin=0.04),
        " ",
        width=3.4,
        height=2.5,
    )
    return Row((*panels, compared))
