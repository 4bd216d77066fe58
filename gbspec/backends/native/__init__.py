"""C kernel of the whole unroll: solution and gradient of a packed batch in one call, if there is a C compiler."""

from gbspec.backends.native.compiler import CompilerError, compiled
from gbspec.backends.native.flat import NUMBER_WORDS, NotCoveredError
from gbspec.backends.native.library import Library, Struct
from gbspec.backends.native.source import TILE, Precision, Source, source

__all__ = [
    "NUMBER_WORDS",
    "TILE",
    "CompilerError",
    "Library",
    "NotCoveredError",
    "Precision",
    "Source",
    "Struct",
    "compiled",
    "source",
]
