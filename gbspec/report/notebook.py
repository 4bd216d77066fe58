"""How results show themselves in a notebook: as the text that the commands print, and as their figures.

IPython asks formatters by type for what to show. They are registered by name, so that nothing is imported for a type
that is never shown.
"""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING, Any

from gbspec.report import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEXTS = (
    ("gbspec.api", "Specification"),
    ("gbspec.api", "FittedRun"),
    ("gbspec.analysis.bifurcation.diagram", "Diagram"),
    ("gbspec.analysis.bifurcation.plane_diagram", "PlaneDiagram"),
    ("gbspec.analysis.bifurcation.eigen", "Eigen"),
    ("gbspec.analysis.prediction.start_comparison", "InitialStates"),
    ("gbspec.analysis.validation.validate", "Validation"),
    ("gbspec.training.profile.likelihood", "Profile"),
)
"""What is shown as the text that `print` gives: module and name of the type."""
FIGURES = (
    ("gbspec.analysis.bifurcation.diagram", "Diagram"),
    ("gbspec.analysis.bifurcation.plane_diagram", "PlaneDiagram"),
    ("gbspec.analysis.prediction.start_comparison", "InitialStates"),
    ("gbspec.training.profile.likelihood", "Profile"),
    ("matplotlib.figure", "Figure"),
)
"""What is drawn too."""


def register() -> None:
    """Registers the formatters where IPython runs; does nothing elsewhere."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is None:
        return
    formatters = shell.display_formatter.formatters
    for module, name in TEXTS:
        formatters["text/plain"].for_type_by_name(module, name, lambda shown, printer, _: printer.text(str(shown)))
    for module, name in FIGURES:
        formatters["image/png"].for_type_by_name(module, name, png)


def figure(shown: Any) -> Figure:
    """The figure of a diagram, curves in a plane, initial states or a profile. Raises `TypeError` for others."""
    from matplotlib.figure import Figure

    from gbspec.analysis.bifurcation.diagram import Diagram
    from gbspec.analysis.bifurcation.plane_diagram import PlaneDiagram
    from gbspec.analysis.prediction.start_comparison import InitialStates
    from gbspec.report import diagram, initial_states, plane, profile
    from gbspec.training.profile.likelihood import Profile

    match shown:
        case Figure():
            return shown
        case Diagram():
            return diagram.diagram(shown)
        case PlaneDiagram():
            return plane.plane(shown)
        case InitialStates():
            return initial_states.initial_states(shown)
        case Profile():
            return profile.draw(shown)
    raise TypeError(f"{type(shown).__name__} has no figure")


def png(shown: Any) -> bytes:
    """The figure as the bytes of a PNG."""
    written = io.BytesIO()
    with style.styled():
        figure(shown).savefig(written, format="png", dpi=80)
    return written.getvalue()
