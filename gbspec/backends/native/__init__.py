"""C for the whole unroll: solution and gradient of a packed batch in one call, compiled where there is a compiler."""

from gbspec.backends.native.compiler import CompilerError, compiled
from gbspec.backends.native.flat import NUMBER_WORDS, NotCoveredError
from gbspec.backends.native.kernel_text import TILE, Precision, Source, source
from gbspec.backends.native.library import Library, Struct

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
