"""Kinds of values that users give to the Python interface, where types are not checked."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from numbers import Complex, Integral, Real
from os import PathLike
from typing import Any, TypeGuard

WRITTEN = "a file to write is given by its path"


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is a whole number, of Python or numpy."""
    return isinstance(value, Integral)


def is_real(value: object) -> TypeGuard[float]:
    """Whether a value is a number: of Python or numpy, a decimal, or an array or tensor without dimensions."""
    if isinstance(value, Real):
        return True
    kind: str = getattr(getattr(value, "dtype", None), "kind", "f")
    if isinstance(value, str | Complex) or kind not in "fiub" or getattr(value, "ndim", 0) != 0:
        return False
    if not hasattr(value, "__float__"):
        return False
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a tensor that is being differentiated
            float(value)
    except (TypeError, ValueError, RuntimeError):  # a symbol, a complex tensor
        return False
    return True


def plain(value: Any) -> Any:
    """A number as an `int` or a `float`, whatever kind of number it was; all else as it is."""
    if not is_real(value):
        return value
    return int(value) if is_whole(value) else float(value)


def shown(value: object) -> str:
    """A value in a message that refuses it: a text in quotes, so that `'3'` is seen to be no number."""
    return repr(value) if isinstance(value, str) else f"{value}"


def plain_values(values: Mapping[str, float]) -> dict[str, float]:
    """Values by name, which are numbers, as those of Python."""
    return {name: plain(value) for name, value in values.items()}


def require_values(values: object) -> None:
    """Raises TypeError if these are no values by name."""
    if not isinstance(values, Mapping):
        raise TypeError(f"values are numbers by name, as in {{'k': 0.5}}, not {type(values).__name__}")
    for name in values:
        if not isinstance(name, str):
            raise TypeError(f"values are numbers by name, as in {{'k': 0.5}}: {name!r} is no name")


def require_path(value: object, meant: str) -> None:
    """Raises TypeError, which says what is `meant`, if a value is no path."""
    if not isinstance(value, str | PathLike):
        raise TypeError(f"{meant}, not by {type(value).__name__}")
