"""Applies TOML tables to a frozen dataclass of options, checking keys and types."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeAlias, TypeVar, Union

T = TypeVar("T")
# A type annotation is `Any` here: a class, a union and `tuple[int, ...]` have no common type.
Fitting: TypeAlias = Any
"""A value of the type that a hint names, which is known only at run time."""
Report = Callable[[str, str, str], None]
"""A callback with a code, the key and a description of the error."""


def overlay(base: T, entry: Mapping[str, object], report: Report) -> T:
    """`base` with the fields that `entry` names (dashes for underscores) replaced; tables add to those of `base`.

    Unknown keys (GB741) and values of another type (GB742) go to `report`.
    """
    hints = typing.get_type_hints(type(base))
    changed: dict[str, object] = {}
    for key, value in entry.items():
        name = key.replace("-", "_")
        if name not in hints:
            known = ", ".join(field.replace("_", "-") for field in hints)
            report("GB741", key, f"is not a known key; known are {known}")
            continue
        try:
            read = convert(hints[name], value)
        except ValueError as error:
            report("GB742", key, f"must be {error}, not {value!r}")
            continue
        if isinstance(read, dict):
            read = {**getattr(base, name), **read}
        changed[name] = read
    return dataclasses.replace(base, **changed)  # type: ignore[type-var]  # T is one of the option dataclasses


def convert(hint: Any, value: object) -> Fitting:
    """`value` converted to the type `hint`; raises ValueError with the expected type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        return _first([a for a in arguments if a is not type(None)], value)
    if origin is Literal:
        if value not in arguments:
            raise ValueError(" or ".join(f"`{a}`" for a in arguments))
        return value
    if origin is tuple:
        return _tuple(arguments, value)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, dict):
            raise ValueError("a table of names and values")
        return {str(name): convert(arguments[1], item) for name, item in value.items()}
    return _scalar(hint, value)


def _first(hints: list[Any], value: object) -> Fitting:
    """The value converted to the first of several types that fits."""
    expected = []
    for hint in hints:
        try:
            return convert(hint, value)
        except ValueError as error:
            expected.append(str(error))
    raise ValueError(" or ".join(dict.fromkeys(expected)))


def _tuple(arguments: tuple[Any, ...], value: object) -> tuple[Fitting, ...]:
    """A list as a tuple of one type (`tuple[str, ...]`), or as a pair of numbers, low and high."""
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        if not isinstance(value, list):
            raise ValueError("a list")
        return tuple(convert(arguments[0], item) for item in value)
    expected = "a range, [low, high]"
    if not isinstance(value, list) or len(value) != len(arguments):
        raise ValueError(expected)
    try:
        pair = tuple(convert(hint, item) for hint, item in zip(arguments, value, strict=True))
    except ValueError:
        raise ValueError(expected) from None
    if not pair[0] <= pair[1]:
        raise ValueError(expected)
    return pair


def _scalar(hint: Any, value: object) -> Fitting:
    """A text, number or truth value; a whole number is accepted as a number, a truth value is not."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is float and number:
        return float(value)  # type: ignore[arg-type]  # a number, as was just checked
    if hint is int and number and isinstance(value, int):
        return value
    if hint is bool and isinstance(value, bool):
        return value
    if hint is str and isinstance(value, str):
        return value
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    raise ValueError(names[hint])
