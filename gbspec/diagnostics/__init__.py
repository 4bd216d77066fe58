"""Places in texts, diagnostics, the catalogue of codes, and rendering as text and JSON."""

from gbspec.diagnostics.diagnostic import (
    ComputationError,
    Defect,
    Diagnostic,
    Findings,
    Label,
    Severity,
    UserError,
)
from gbspec.diagnostics.span import Cell, Place, Source, Span

__all__ = [
    "Cell",
    "ComputationError",
    "Defect",
    "Diagnostic",
    "Findings",
    "Label",
    "Place",
    "Severity",
    "Source",
    "Span",
    "UserError",
]
