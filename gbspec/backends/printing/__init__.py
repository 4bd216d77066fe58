"""Expressions as text: one printer base, straight lists of statements, safe names."""

from gbspec.backends.printing.names import Names, docstring, identifier
from gbspec.backends.printing.nodes import temporary
from gbspec.backends.printing.printer import Printer, PythonPrinter, TextPrinter
from gbspec.backends.printing.statements import Assignment, NetworkCall, Program, Statement

__all__ = [
    "Assignment",
    "Names",
    "NetworkCall",
    "Printer",
    "Program",
    "PythonPrinter",
    "Statement",
    "TextPrinter",
    "docstring",
    "identifier",
    "temporary",
]
