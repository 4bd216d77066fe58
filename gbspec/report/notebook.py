"""The display of results in a notebook: the text that the commands print, and their figures.

IPython asks formatters by type for what to show. They are registered by name, so that nothing is imported for a type
that is never shown.
"""

from __future__ import annotations

import io
import sys
from typing import TYPE_CHECKING

from gbspec.report import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEXTS = (
    ("gbspec.api", "Specification"),
    ("gbspec.fitted", "FittedRun"),
    ("gbspec.analysis.bifurcation.diagram", "Diagram"),
    ("gbspec.analysis.bifurcation.plane_diagram", "PlaneDiagram"),
    ("gbspec.analysis.bifurcation.eigen", "Eigen"),
    ("gbspec.analysis.prediction.start_comparison", "InitialStates"),
    ("gbspec.analysis.validation.validate", "Validation"),
    ("gbspec.training.profile.likelihood", "Profile"),
)
"""Types that are displayed by the text of `print`: module and name of the type."""
FIGURES = (
    ("gbspec.analysis.bifurcation.diagram", "Diagram"),
    ("gbspec.analysis.bifurcation.plane_diagram", "PlaneDiagram"),
    ("gbspec.analysis.prediction.start_comparison", "InitialStates"),
    ("gbspec.training.profile.likelihood", "Profile"),
    ("matplotlib.figure", "Figure"),
)
"""Types that are also displayed by a figure."""


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


def figure(shown: object) -> Figure:
    """The figure of a diagram, curves in a plane, initial states, eigenvalues or a profile; `TypeError` for others."""
    from matplotlib.figure import Figure

    from gbspec.report.files import result

    return shown if isinstance(shown, Figure) else result(shown)


def png(shown: object) -> bytes:
    """The figure as the bytes of a PNG."""
    written = io.BytesIO()
    with style.styled():
        figure(shown).savefig(written, format="png", dpi=80)
    return written.getvalue()
