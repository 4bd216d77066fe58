"""Bifurcation diagrams over two parameters: all Hopf and fold curves in a box of the plane.

Diagrams over either parameter at several values of the other give Hopf points and folds; each that is on no curve
found so far starts a new curve. If a Hopf curve ends in a Bogdanov-Takens point, the fold curve through it is followed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import polars as pl

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate, require_range
from gbspec.analysis.bifurcation.plane import PlaneCurve, PlaneFamily, PlanePoint, fold_curve, hopf_curve
from gbspec.analysis.systems import Box, System
from gbspec.arrays import Array
from gbspec.frames import Shown, of_rows

LINES = 5
"""The number of values of either parameter at which diagrams over the other are computed."""
ACROSS = BifurcationOptions(values=3, starts=32, cycles=False)
"""Options of these diagrams."""
ON_CURVE = 2e-3
"""A point closer than this to a curve, relative to the box and the states' scale, counts as on it: steps along a curve
are at most 0.02 long and rotate the tangent by at most 0.2, so the error of chords is at most a quarter of this."""

KINDS = {"bautin": "Bautin point", "bogdanov_takens": "Bogdanov-Takens point", "cusp": "cusp"}


@dataclass(frozen=True, repr=False)
class PlaneDiagram(Shown):
    """The Hopf and fold curves of a system in a box of the plane of two parameters.

    `trained` holds both parameters' trained (else plausible) ranges, None for an unknown one. `corners`: there are
    folds at corners of the equations, too, which are not followed.
    """

    name: str
    parameters: tuple[str, str]
    boxes: tuple[Box, Box]
    curves: tuple[PlaneCurve, ...]
    trained: tuple[Box | None, Box | None] = (None, None)
    corners: bool = False

    def to_frame(self) -> pl.DataFrame:
        """One row for each point: `curve`, `kind`, both parameters, and the states."""
        return of_rows(
            {
                "curve": number,
                "kind": curve.kind,
                **dict(zip(self.parameters, point.values, strict=True)),
                **{name: float(value) for name, value in zip(curve.states, point.state, strict=True)},
            }
            for number, curve in enumerate(self.curves)
            for point in curve.points
        )

    def to_json(self) -> dict[str, object]:
        """The document of `bifurcate --and --json`."""
        return {
            "parameters": list(self.parameters),
            "ranges": [list(box) for box in self.boxes],
            "curves": [curve.to_json() for curve in self.curves],
            "trained": [None if box is None else list(box) for box in self.trained],
        }

    def __str__(self) -> str:
        (a, b), (first, second) = self.parameters, self.boxes
        lines = [
            f"{self.name} over {a} from {first[0]:.6g} to {first[1]:.6g}"
            f" and {b} from {second[0]:.6g} to {second[1]:.6g}"
        ]
        for curve in self.curves:
            beyond = sum(bool(point.outside) for point in curve.points)
            spans = (
                f"{name} {min(values):.6g} to {max(values):.6g}"
                for name, values in zip(
                    self.parameters, zip(*(point.values for point in curve.points), strict=True), strict=True
                )
            )
            word = "Hopf curve" if curve.kind == "hopf" else "fold curve"
            lines.append(
                f"  {word}: {', '.join(spans)}, {len(curve.points)} points"
                + (f", {beyond} outside of data or declared ranges" if beyond else "")
                + ("; closed" if curve.ends[1] == "closed" else f"; ends: {', '.join(curve.ends)}")
            )
            for kind, point in curve.special:
                x, y = point.values
                lines.append(f"    {KINDS[kind]} at {a} = {x:.8g}, {b} = {y:.8g}")
        if self.corners:
            lines.append(
                "  there are non-smooth folds, which are not followed in a plane: vary one parameter to see them"
            )
        if not self.curves:
            lines.append(f"  no Hopf points and no {'other ' if self.corners else ''}folds")
        return "\n".join(lines)


def bifurcation_plane(
    system: System,
    names: tuple[str, str],
    boxes: tuple[Box, Box],
    progress: Callable[[str], None] | None = None,
) -> PlaneDiagram:
    """All Hopf and fold curves that are found from diagrams along `LINES` lines in either direction.

    Raises UserError if there is no such parameter (GB872), if the system depends on time (GB873) or a number is missing
    (GB871), and if a range is invalid (GB875).
    """
    for name, box in zip(names, boxes, strict=True):
        require_range(name, *box)
    PlaneFamily(system, *names)  # reports errors in the names before anything is computed
    search = _Search(system, names, boxes, progress or (lambda text: None))
    for along in (0, 1):
        low, high = boxes[1 - along]
        for part in (np.arange(LINES) + 0.5) / LINES:
            search.line(along, low + float(part) * (high - low))
    known = [system.trained.get(name, system.range(name)) for name in names]
    first, second = (box if np.isfinite(box).all() else None for box in known)
    return PlaneDiagram(system.name, names, boxes, tuple(search.curves), (first, second), search.corners)


class _Search:
    """Finds and collects the curves of a diagram."""

    def __init__(
        self, system: System, names: tuple[str, str], boxes: tuple[Box, Box], progress: Callable[[str], None]
    ) -> None:
        self.system, self.names, self.boxes, self.progress = system, names, boxes, progress
        self.curves: list[PlaneCurve] = []
        self.corners = False
        self.widths = np.concatenate([system.scale, [high - low for low, high in boxes]])

    def line(self, along: int, other: float) -> None:
        """Follows the curves through the Hopf points and folds over one parameter at a value of the other."""
        fixed = self.system.with_values({self.names[1 - along]: other})
        found = bifurcate(fixed, self.names[along], *self.boxes[along], ACROSS)
        self.corners |= bool(found.of_kind("nonsmooth_fold"))
        for point in found.of_kind("hopf", "fold"):
            values = (point.value, other) if along == 0 else (other, point.value)
            self.follow("hopf" if point.kind == "hopf" else "fold", point.state, values)
        self.progress(f"{self.names[1 - along]} = {other:.6g}: {len(self.curves)} curves so far")

    def follow(self, kind: str, state: Array, values: tuple[float, float]) -> None:
        """Follows the curve through a point, unless the point is on a known one."""
        if any(curve.kind == kind and self._on(curve, state, values) for curve in self.curves):
            return
        trace = hopf_curve if kind == "hopf" else fold_curve
        curve = trace(self.system, self.names, self.boxes, state, values)
        if len(curve.points) < 2:
            return
        self.curves.append(curve)
        for what, point in curve.special:
            if kind == "hopf" and what == "bogdanov_takens" and self._inside(point):
                self.follow("fold", point.state, point.values)

    def _inside(self, point: PlanePoint) -> bool:
        return all(low <= value <= high for value, (low, high) in zip(point.values, self.boxes, strict=True))

    def _on(self, curve: PlaneCurve, state: Array, values: tuple[float, float]) -> bool:
        """Whether a point lies on a curve, to within `ON_CURVE`."""
        here = np.concatenate([state, values]) / self.widths
        nodes = np.array([np.concatenate([point.state, point.values]) for point in curve.points]) / self.widths
        pieces = np.diff(nodes, axis=0)
        lengths = np.maximum(np.sum(pieces**2, axis=1), 1e-300)
        parts = np.clip(np.sum((here - nodes[:-1]) * pieces, axis=1) / lengths, 0.0, 1.0)
        nearest = nodes[:-1] + parts[:, None] * pieces
        return bool(np.min(np.max(np.abs(nearest - here), axis=1)) < ON_CURVE)
