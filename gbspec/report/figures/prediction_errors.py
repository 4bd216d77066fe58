"""Normalised prediction distribution errors of a population over time and prediction, and their quantiles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import norm

from gbspec.arrays import Array
from gbspec.report.collect import channel_unit, population_tables
from gbspec.report.description import Axis, Block, Figure, Line, Panel, Points, Row, Rule
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, MUTED
from gbspec.runs import ErrorsRecord


def build(source: Source) -> Figure:
    """One row per channel."""
    found, record = population_tables(source.run), source.run.fit.population
    if found is None or record is None or "npde" not in found.arrays:
        raise MissingError("the run has no prediction errors: it has no population, or is older than they", "residuals")
    model = source.run.model
    time = Axis(model.time.name, model.time.unit or "", margin=0.03)
    rows = []
    for index, channel in enumerate(model.channels):
        here = (found.arrays["channel"] == index) & np.isfinite(found.arrays["npde"])
        if here.any():
            part = {name: found.arrays[name][here] for name in ("time", "population", "npde")}
            names = tuple(found.labels[int(i)] for i in found.arrays["owner"][here])
            predicted = Axis(f"{channel.name}, predicted for the population", channel_unit(model, channel), margin=0.04)
            title = _title(channel.name, record.npde.get(channel.name))
            rows.append(_row(title, (time, predicted), part, names))
    if not rows:
        raise MissingError("too few populations were simulated for prediction errors", "weighted-residuals")
    return Figure(((Block(tuple(rows), "below"),),))


def _title(name: str, tested: ErrorsRecord | None) -> str:
    if tested is None:
        return name
    return f"{name}: mean {tested.mean:.2f}, variance {tested.variance:.2f}, p = {tested.p:.2g}"


def _row(title: str, axes: tuple[Axis, Axis], part: Mapping[str, Array], labels: tuple[str, ...]) -> Row:
    y = Axis("prediction error")
    panels = [
        Panel(
            (Rule("y", 0.0), Rule("y", 1.96, dash="dotted"), Rule("y", -1.96, dash="dotted"),
             Points(x, part["npde"], "", LEARNED, 3.0, alpha=0.6, layer=3, hover=labels)),
            axis, y, said, width=3.4, height=2.5,
        )
        for x, axis, said in ((part["time"], axes[0], title), (part["population"], axes[1], " "))
    ]  # fmt: skip
    ordered = np.sort(part["npde"])
    quantiles = norm.ppf((np.arange(len(ordered)) + 0.5) / len(ordered))
    ends = np.array([quantiles.min(), quantiles.max()])
    against = Panel(
        (
            Line(ends, ends, "", MUTED, 1.0, "dashed"),
            Points(quantiles, ordered, "", LEARNED, 3.0, alpha=0.8, layer=3),
        ),
        Axis("standard normal quantile", margin=0.04),
        Axis("ordered prediction error", margin=0.04),
        " ",
        width=3.4,
        height=2.5,
    )
    return Row((*panels, against))
