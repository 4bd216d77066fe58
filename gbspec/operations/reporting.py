"""Figures and the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import packages
from gbspec.operations import analysing
from gbspec.operations.models import learned

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from gbspec.analysis import Diagram, PlaneDiagram
    from gbspec.data import Trajectories
    from gbspec.runs import Run
    from gbspec.training import Profile


@packages()
def diagram_figure(diagrams: Sequence[Diagram], truth: Diagram | None = None) -> Figure:
    """The figure of one or several members' diagrams, together with the truth's."""
    from gbspec.report import diagram

    return diagram(analysing.joined(diagrams), diagrams[1:], truth)


@packages()
def plane_figure(diagrams: Sequence[PlaneDiagram], truth: PlaneDiagram | None = None) -> Figure:
    """The figure of one or several members' curves, together with the truth's."""
    from gbspec.report import plane

    return plane(diagrams[0], diagrams[1:], truth)


@packages()
def profile_figure(run: Run, found: Profile) -> Figure:
    """The figure of a profile, with the truth if the model has one."""
    from gbspec.report import profile as draw

    truths = {t.name: t.value for t in run.model.truth_constants}
    return draw(found, truths.get(found.name))


@packages()
def figure(kind: str, run: Run, data: Trajectories | None, show: Sequence[str] = ()) -> Figure:
    """A figure of a run: one of `gbspec.report.kinds`."""
    from gbspec.report import draw

    return draw(kind, run, data, show)


@packages()
def report(
    run: Run,
    data: Trajectories | None,
    path: str | Path,
    *,
    diagram: tuple[str, float, float] | None = None,
    cycles: bool = False,
) -> None:
    """Writes the report of a run as one HTML file; `diagram` names a parameter and its range."""
    from gbspec.files import write_text
    from gbspec.report import Findings as Found
    from gbspec.report import Fitted, page

    source = learned(run)
    drawn = None
    if diagram is not None:
        drawn = (
            analysing.bifurcate(source, *diagram, cycles=cycles),
            analysing.true_diagram(source, *diagram, cycles=cycles),
        )
    spectra = None if data is None or run.model.events else analysing.eigen(source, along=data)
    fitted = None if data is None else Fitted(run, data)
    write_text(path, page(fitted, run, Found(analysing.validate(run, data), spectra, drawn)))
