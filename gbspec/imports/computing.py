"""Values of constant formulas, among them factorials, which are written as numbers.

A formula is computed by its tree; no text is evaluated.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

from gbspec.imports.formulas import Formula, number, substituted, walk

FACTORIAL = "factorial"
"""A function that the language does not have."""
_FUNCTIONS: dict[str, Callable[..., float]] = {
    **{name: getattr(math, name) for name in ("exp", "log", "log10", "sqrt", "sin", "cos", "tan", "sinh", "cosh")},
    **{name: getattr(math, name) for name in ("tanh", "asin", "acos", "atan", "asinh", "acosh", "atanh")},
    "abs": abs,
    "min": min,
    "max": max,
    "sign": lambda x: (x > 0) - (x < 0),
    "floor": math.floor,
    "ceil": math.ceil,
    "mod": lambda x, y: x - y * math.floor(x / y),
    FACTORIAL: lambda x: math.gamma(x + 1),
}
_OPERATORS: dict[str, Callable[..., float]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": math.pow,
    "neg": operator.neg,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "not": operator.not_,
}


class NotConstantError(Exception):
    """A formula has no constant value."""


def value_of(formula: Formula, known: Mapping[str, float]) -> float:
    """The value of a formula of numbers and known names. Raises `NotConstantError`."""
    try:
        found = float(_value(formula, known))
    except (ArithmeticError, ValueError, OverflowError):
        raise NotConstantError from None
    if not math.isfinite(found):
        raise NotConstantError
    return found


def _value(node: Formula, known: Mapping[str, float]) -> float:
    match node.head:
        case "number":
            return node.value
        case "name":
            if node.name not in known:
                raise NotConstantError
            return known[node.name]
        case "pi":
            return math.pi
        case "true" | "false":
            return node.head == "true"
        case "if":
            return _value(node.parts[1 if _value(node.parts[0], known) else 2], known)
        case "and":
            return all(_value(part, known) for part in node.parts)
        case "or":
            return any(_value(part, known) for part in node.parts)
        case "call":
            return _FUNCTIONS[node.name](*(_value(part, known) for part in node.parts))
        case head if head in _OPERATORS:
            return _OPERATORS[head](*(_value(part, known) for part in node.parts))
        case _:
            raise NotConstantError


def decided(formula: Formula, known: Mapping[str, float], ranges: Mapping[str, tuple[float, float]]) -> bool | None:
    """Whether a condition holds wherever names of `ranges` lie between their bounds; None if that is not known."""
    from mpmath import iv

    def value(node: Formula) -> Any:
        match node.head:
            case "number":
                return iv.mpf(node.value)
            case "name" if node.name in known:
                return iv.mpf(known[node.name])
            case "name" if node.name in ranges:
                return iv.mpf(list(ranges[node.name]))
            case "true" | "false":
                return node.head == "true"
            case "and" | "or" | "not":
                return logical(node.head, [value(part) for part in node.parts])
            case "call" if node.name in ("exp", "log", "sqrt"):
                return getattr(iv, node.name)(value(node.parts[0]))
            case "+" | "-" | "*" | "/" | "neg" | "<" | "<=" | ">" | ">=":
                return _OPERATORS[node.head](*map(value, node.parts))
            case _:
                raise NotConstantError

    try:
        found = value(formula)
    except (NotConstantError, ArithmeticError, ValueError, TypeError):
        return None
    return found if isinstance(found, bool) else None


def logical(word: str, parts: list[bool | None]) -> bool | None:
    """`and`, `or` and `not` of what may not be known."""
    if word == "not":
        return None if parts[0] is None else not parts[0]
    if (word == "or") in parts:
        return word == "or"
    return None if None in parts else word == "and"


def has_factorial(formula: Formula) -> bool:
    """Whether a formula has a factorial."""
    return any(node.head == "call" and node.name == FACTORIAL for node in walk(formula))


def computed(formula: Formula, known: Mapping[str, float]) -> Formula:
    """A formula with numbers in place of factorials. Raises `NotConstantError` if an argument is not constant."""

    def put(node: Formula) -> Formula | None:
        return number(value_of(node, known)) if node.head == "call" and node.name == FACTORIAL else None

    return substituted(formula, put)
