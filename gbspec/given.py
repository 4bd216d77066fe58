"""Kinds of values that users give to the Python interface, where types are not checked."""

from __future__ import annotations

from numbers import Integral, Real
from os import PathLike


def is_whole(value: object) -> bool:
    """Whether a value is a whole number, of Python or numpy."""
    return isinstance(value, Integral)


def is_real(value: object) -> bool:
    """Whether a value is a number, of Python or numpy."""
    return isinstance(value, Real)


def require_path(value: object, meant: str) -> None:
    """Raises TypeError, which says what is `meant`, if a value is no path."""
    if not isinstance(value, str | PathLike):
        raise TypeError(f"{meant}, not by {type(value).__name__}")
