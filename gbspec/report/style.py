"""The look of all figures: one palette, one set of matplotlib settings, and how they are saved."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.files import aside, writable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEARNED, TRUTH, MEASURED, MUTED = "#1f5fa8", "#2b2b2b", "#d9622b", "#8a8f98"
"""Colours of learned curves, the truth, measurements and secondary marks; distinct in grey and to the colour-blind."""
MEMBERS = ("#1f5fa8", "#3a8f5c", "#8e5ea2", "#c2872b", "#4aa3b8", "#b14a5b")
"""Colours of members, or of states, if several are drawn."""
CYCLE, FOLD = MEMBERS[1], MEMBERS[2]
"""Limit cycles; folds."""
BEHIND = "#c3c7cd"
"""The truth behind diagrams, where dashes would look like unstable parts."""
FORMS = (".png", ".svg", ".pdf")

_SETTINGS: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.labelcolor": "#333333",
    "axes.edgecolor": "#9aa0a8",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e8eaed",
    "grid.linewidth": 0.7,
    "axes.axisbelow": True,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.7,
    "lines.solid_capstyle": "round",
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "figure.facecolor": "white",
    "svg.fonttype": "none",
    "svg.hashsalt": "gbspec",
}


@contextmanager
def styled() -> Iterator[None]:
    """A context with the settings for figures; nothing global is changed."""
    import matplotlib as mpl

    with mpl.rc_context(_SETTINGS):
        yield


def figure(width: float, height: float) -> Figure:
    """An empty figure (size in inches), without a window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def form_of(path: str | Path) -> Path:
    """The path, if a figure can be written there; raises `UserError` (GB812 for the suffix, GB802, GB803)."""
    target = Path(path)
    if target.suffix.lower() not in FORMS:
        message = f"the file name extension of `{path}` is not that of a figure format"
        raise UserError([Diagnostic("GB812", message, None, help=f"end the name in one of {', '.join(FORMS)}")])
    return writable(target)


def save(made: Figure, path: str | Path) -> None:
    """Writes the figure in the format of its suffix, without a date: the same figure gives the same bytes."""
    target = form_of(path)
    clocks: dict[str, dict[str, Any]] = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    metadata = clocks.get(target.suffix.lower(), {})
    with styled(), aside(target) as temporary:
        made.savefig(temporary, format=target.suffix.lower()[1:], metadata=metadata)
