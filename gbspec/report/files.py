"""Figures for files and notebooks: of a run by their kind, and of results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gbspec.analysis import Diagram, Eigen, InitialStates, PlaneDiagram
from gbspec.data import Trajectories
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.report.drawn import drawn
from gbspec.report.figures import diagram as diagrams
from gbspec.report.figures import eigenvalues, initial_states
from gbspec.report.figures import plane as planes
from gbspec.report.figures import profile as profiles
from gbspec.report.kinds import kind_of
from gbspec.report.source import MissingError, Source
from gbspec.runs import Run
from gbspec.training import Profile

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(kind: str, run: Run, data: Trajectories | None, show: Sequence[str] = ()) -> Figure:
    """The figure of that kind; `show` names trajectories by label (default: the first four).

    Raises `UserError` (GB813) if the run, the model or the data lack the content of the figure, `ValueError` if there
    is no such kind.
    """
    found = kind_of(kind)
    try:
        return drawn(found.build(Source(run, data, tuple(show))))
    except MissingError as missing:
        message = f"the figure `{found.name}` cannot be drawn: {missing.why}"
        help = f"`{missing.instead}` can be drawn instead"
        raise UserError([Diagnostic("GB813", message, None, help=help)]) from missing


def diagram(shown: Diagram, others: Sequence[Diagram] = (), truth: Diagram | None = None) -> Figure:
    """A bifurcation diagram, with those of other members and of the truth."""
    return drawn(diagrams.figure(shown, others, truth))


def plane(shown: PlaneDiagram, others: Sequence[PlaneDiagram] = (), truth: PlaneDiagram | None = None) -> Figure:
    """Hopf and fold curves, with those of other members and of the truth."""
    return drawn(planes.figure(shown, others, truth))


def profile(found: Profile, truth: float | None = None) -> Figure:
    """The profile likelihood of a constant."""
    return drawn(profiles.figure(found, truth))


def result(shown: object) -> Figure:
    """The figure of a result. Raises `TypeError` for objects without a figure."""
    match shown:
        case Diagram():
            return diagram(shown)
        case PlaneDiagram():
            return plane(shown)
        case InitialStates():
            return drawn(initial_states.figure(shown))
        case Eigen():
            return drawn(eigenvalues.figure(shown))
        case Profile():
            return profile(shown)
    raise TypeError(f"{type(shown).__name__} has no figure")
