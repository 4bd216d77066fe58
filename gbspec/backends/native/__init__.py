"""C for the whole unroll: solution and gradient of a packed batch in one call, compiled where there is a compiler."""

from gbspec.backends.native.compiler import CompilerError, compiled
from gbspec.backends.native.flat import NotCoveredError
from gbspec.backends.native.source import source

__all__ = ["CompilerError", "NotCoveredError", "compiled", "source"]
