"""The unknown functions over the region that the data cover: along each argument, over planes, against the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.report.content import LearnedFunction, Plane, Slice
from gbspec.report.description import (
    Axis,
    Band,
    Block,
    Figure,
    Heat,
    Line,
    Mark,
    Panel,
    Points,
    Row,
    Rug,
    beyond,
    diagonal,
    ensemble,
    extrapolated,
    truth,
    wrapped,
)
from gbspec.report.source import MissingError, Source
from gbspec.report.style import LEARNED, MUTED

ACROSS = 3
"""Number of panels side by side."""
SLICES = 3
"""Number of slices of a function in a file; those along which it varies most come first."""
OUTERMOST = 0.002
"""The share of values at either end that the comparison with the truth leaves out."""


def build(source: Source) -> Figure:
    """Every unknown of the model."""
    fitted = source.fitted
    if not fitted.model.unknowns:
        raise MissingError("every function of the model is known", "constants")
    return figure(source.functions, None if source.page else SLICES)


def figure(learned: Sequence[LearnedFunction], slices: int | None = SLICES) -> Figure:
    """One block per function: `slices` slices (None: all), a plane if it has several arguments, and the truth."""
    blocks = []
    for function in learned:
        shown = [
            slice_panel(function.name, piece, function.unit, legend=k == 0)
            for k, piece in enumerate(function.slices[:slices])
        ]
        if function.plane is not None:
            shown += planes(function.name, function.plane)
        if function.truth is not None:
            shown.append(parity_panel(function.name, function.truth, function.members.mean(axis=0), function.unit))
        first, *others = wrapped(tuple(shown), ACROSS) or (Row((None,)),)
        heading = f"{function.name} of {', '.join(function.arguments)}"
        blocks.append((Block((Row(first.panels, heading), *others)),))
    return Figure(tuple(blocks))


def slice_panel(name: str, piece: Slice, unit: str = "", *, legend: bool = True) -> Panel:
    """A function along one argument, with its 90 % band, its truth and its postulate.

    Ticks show the positions of data; the background is grey where the function is extrapolated.
    """
    ends = float(piece.x[0]), float(piece.x[-1])
    grounds = beyond("x", ends, piece.trained) if piece.far is None else extrapolated(piece.x, piece.far)
    marks: list[Mark] = [*grounds]
    if piece.band is not None:
        marks.append(Band(piece.x, piece.band[0], piece.band[1], "90 % band", alpha=0.12))
    if piece.postulate is not None:
        marks.append(Line(piece.x, piece.postulate, "postulate", MUTED, 1.5, "dotted", layer=2))
    marks += ensemble(piece.x, piece.members)
    if piece.truth is not None:
        marks.append(truth(piece.x, piece.truth))
    if piece.visited is not None:
        marks.append(Rug(piece.visited))
    x = Axis(piece.argument, piece.unit, margin=0.02)
    return Panel(tuple(marks), x, Axis(name, unit), _at(name, piece.label), legend)


def planes(name: str, plane: Plane) -> list[Panel]:
    """A function over the plane of two arguments, its truth in the same colours, and half the width of its band."""
    shown = [("learned", plane.learned)] + ([("truth", plane.truth)] if plane.truth is not None else [])
    low = min(float(np.nanmin(values)) for _, values in shown)
    high = max(float(np.nanmax(values)) for _, values in shown)
    scaled = [(word, values, low, high) for word, values in shown]
    if plane.half is not None:
        scaled.append(("half the 90 % band", plane.half, 0.0, float(np.nanmax(plane.half))))
    return [
        Panel((Heat(plane.x, plane.y, values, *ends),), Axis(plane.x_name, plane.units[0]),
              Axis(plane.y_name, plane.units[1]), _at(f"{name}, {word}", plane.label))
        for word, values, *ends in scaled
    ]  # fmt: skip


def parity_panel(name: str, true: Array, learned: Array, unit: str = "") -> Panel:
    """Learned against true values [P], the outermost left out."""
    low, high = np.quantile(np.concatenate([learned, true]), [OUTERMOST, 1 - OUTERMOST])
    shown = (np.minimum(learned, true) >= low) & (np.maximum(learned, true) <= high)
    error = float(np.median(np.abs(learned - true)))
    share = f"{100 * error / (high - low):.2g} % of range" if high > low else f"{error:.2g}"
    points = Points(true[shown], learned[shown], "learned", LEARNED, 2.4, alpha=0.45, layer=3)
    return Panel((diagonal(float(low), float(high)), points), Axis(f"true {name}", unit), Axis(f"learned {name}", unit),
                 f"median error {share}")  # fmt: skip


def _at(text: str, where: str) -> str:
    return f"{text} at {where}" if where else text
