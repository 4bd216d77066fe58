"""Eigenvalues of the Jacobian in the complex plane, at all points where it was computed."""

from __future__ import annotations

import numpy as np

from gbspec.analysis import Eigen, eigen, predictions, system_of
from gbspec.arrays import Array
from gbspec.data import evenly_spaced
from gbspec.report.description import Axis, Figure, Mark, Panel, Points, Rule, single
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, TRUTH

MOST = 400
"""Largest number of points whose eigenvalues are drawn; of more points, evenly spaced ones are selected."""


def build(source: Source) -> Figure:
    """The eigenvalues along the data, with those of the truth if there is one."""
    if source.run.model.events:
        raise MissingError("equations that switch at events have no eigenvalues along the data", "fit")
    found = along(source) if source.spectra is None else source.spectra
    if not found.points:
        raise MissingError("there is no point with a finite Jacobian", "fit")
    return figure(found, source.run.model.time.unit or "")


def along(source: Source) -> Eigen:
    """The eigenvalues of the first member along the data."""
    fitted, model = source.fitted, source.run.model
    evaluator = fitted.evaluators[0]
    truth = None if fitted.truth is None else system_of(fitted.truth, model)
    predicted = predictions(evaluator, model, fitted.data, source.run.fit)
    return eigen(system_of(evaluator, model), truth=truth, along=fitted.data, predicted=predicted)


def figure(found: Eigen, time: str = "") -> Figure:
    """Learned eigenvalues as points, true ones as circles; the few that lie far to the left are outside the view."""
    points = [found.points[i] for i in evenly_spaced(len(found.points), MOST)]
    learned = np.concatenate([np.zeros(0, complex), *(point.eigenvalues for point in points)])
    marks: list[Mark] = [Rule("x", 0.0), Points(learned.real, learned.imag, "learned", LEARNED, 3.2, alpha=0.6)]
    true = [point.truth for point in points if point.truth is not None]
    if true:
        values = np.concatenate(true)
        marks.append(Points(values.real, values.imag, "truth", TRUTH, 4.4, alpha=0.5, hollow=True, layer=4))
    every = np.concatenate([learned, *true]).real
    view = _view(every)
    left_out = int(np.sum(every < view[0])) if view else 0
    title = f"{left_out} of {len(every)} lie further left" if left_out else ""
    x = Axis("real part", f"1/{time}" if time else "", range=view)
    return single(Panel(tuple(marks), x, Axis("imaginary part", x.unit), title, legend=True, width=5.4, height=3.4))


def _view(values: Array) -> tuple[float, float] | None:
    """The range without the lowest hundredth of the values, if these would compress the rest; else None."""
    if not len(values):
        return None
    low, high = float(np.quantile(values, 0.01)), float(values.max())
    if low - values.min() < 2.0 * (high - low):
        return None
    margin = 0.1 * (high - low)
    return low - margin, high + margin
