"""Expressions as text: the base of all printers, lists of assignments, safe names."""

from gbspec.backends.printing.names import Names, docstring, identifier
from gbspec.backends.printing.nodes import STATE, VectorTemporary, is_vector, temporary
from gbspec.backends.printing.printer import Printer, PythonPrinter, TextPrinter
from gbspec.backends.printing.statements import Assignment, NetworkCall, Program, Statement
from gbspec.backends.printing.vectors import Vectors

__all__ = [
    "STATE",
    "Assignment",
    "Names",
    "NetworkCall",
    "Printer",
    "Program",
    "PythonPrinter",
    "Statement",
    "TextPrinter",
    "VectorTemporary",
    "Vectors",
    "docstring",
    "identifier",
    "is_vector",
    "temporary",
]
