"""Trajectories in the plane of the first two states."""

from __future__ import annotations

from collections.abc import Sequence

from gbspec.report import collect
from gbspec.report.content import Orbit
from gbspec.report.description import Axis, Figure, Line, Mark, Panel, Points, measured, single, true_solution
from gbspec.report.source import MissingError, Source

IN_FILE, ON_PAGE = 4, 8
"""Number of trajectories if none are named: more would overlap."""


def build(source: Source) -> Figure:
    """The phase portrait of some trajectories."""
    if len(source.run.model.states) < 2:
        raise MissingError("the model has only one state", "fit")
    orbits = collect.orbits(source.fitted, source.some(IN_FILE, ON_PAGE), (0, 1))
    first, second = source.run.model.states[:2]
    axes = Axis(first.name, first.unit or ""), Axis(second.name, second.unit or "")
    return figure(orbits, *axes, collect.solution_label(source.run.model))


def figure(orbits: Sequence[Orbit], x: Axis, y: Axis, solution: str = "model") -> Figure:
    """Trajectories of the model with dots at their initial states, the truth dashed, joint measurements as points;
    `solution`: what the trajectories are."""
    marks: list[Mark] = []
    for orbit in orbits:
        path, words = orbit.learned, (f"trajectory {orbit.label}",)
        marks.append(Line(path[:, 0], path[:, 1], solution, width=1.2, alpha=0.85, hover=words * len(path)))
        marks.append(Points(path[:1, 0], path[:1, 1], size=3.5, layer=4, hover=words))
        if orbit.truth is not None:
            marks.append(true_solution(orbit.truth[:, 0], orbit.truth[:, 1]))
        if len(orbit.measured):
            marks.append(measured(orbit.measured[:, 0], orbit.measured[:, 1]))
    return single(Panel(tuple(marks), x, y, legend=True, width=5.2, height=4.3))
