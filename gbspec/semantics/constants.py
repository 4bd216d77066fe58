"""Evaluates expressions of numbers and constants in float64 on the syntax tree; no text is run as Python."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from typing import assert_never

from gbspec.semantics.expressions import chain, fold, operands
from gbspec.semantics.vocabulary import CONSTANTS
from gbspec.syntax import FUNCTIONS, ast

_SEVERAL = ("atan2", "mod", "min", "max")
_ONE: dict[str, Callable[[float], float]] = {
    **{name: getattr(math, name) for name in FUNCTIONS if name not in ("abs", "sign", *_SEVERAL)},
    "abs": math.fabs,
    "sign": lambda x: float((x > 0) - (x < 0)),
    "floor": lambda x: float(math.floor(x)),
    "ceil": lambda x: float(math.ceil(x)),
}

_COMPARE: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
}

Functions = Mapping[str, ast.FunctionStatement]
DEEPEST = 100
MOST_CALLS = 10_000
"""Functions that call each other deeper, or with more different arguments, are not evaluated: they may be recursive."""

NotFinite = Callable[[ast.Expression, float, bool], None]
"""A callback with the expression, its value, and whether it is a division by zero."""


def apply(function: str, arguments: list[float]) -> float:
    """The value of a function of the language; nan or inf if it has no finite real value."""
    try:
        if function == "min":
            return min(arguments)
        if function == "max":
            return max(arguments)
        if function == "atan2":
            return math.atan2(*arguments)
        if function == "mod":
            return _remainder(*arguments)
        return _ONE[function](*arguments)
    except OverflowError:
        return math.inf
    except ValueError:
        return math.nan


def _remainder(x: float, y: float) -> float:
    """`mod(x, y)`, computed as all backends do (`lower.expressions`); nan where y is 0."""
    return x - y * math.floor(x / y) if y else math.nan


def power(base: float, exponent: float) -> float:
    """`base^exponent` over the reals; nan or inf if there is no finite value."""
    try:
        return math.pow(base, exponent)
    except OverflowError:
        return math.inf
    except ValueError:
        return math.inf if base == 0 else math.nan


class Evaluator:
    """Evaluates expressions of constants; a sub-expression with any other name, and all that contain it, give None.

    `not_finite` is called with the smallest sub-expression that is inf or nan; its value is then None, so that one
    error is reported once. Branches of an `if` count only if they are taken.
    """

    def __init__(self, values: Mapping[str, float], functions: Functions, not_finite: NotFinite | None = None) -> None:
        self._values = values
        self._functions = functions
        self._not_finite = not_finite
        self._depth = 0
        self._known: dict[tuple[str, tuple[float, ...]], float | None] = {}

    def __call__(self, node: ast.Expression, formals: Mapping[str, float | None] | None = None) -> float | None:
        """The value in float64, or None. `formals` shadow the constants (None: an argument of unknown value)."""
        shadow = formals or {}
        if self._depth == 0:
            self._known.clear()
        return fold(node, lambda n, values: self._combine(n, values, shadow), _counted)

    def _combine(
        self, node: ast.Expression, values: list[float | None], formals: Mapping[str, float | None]
    ) -> float | None:
        if isinstance(node, ast.Conditional):
            if values[0] is None:
                return None
            return self(node.then if values[0] else node.otherwise, formals)
        if isinstance(node, ast.Name):
            if node.text in formals:
                return formals[node.text]
            return self._values.get(node.text, CONSTANTS.get(node.text))
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            if self._not_finite is not None and _divides_by_zero(node, values):
                self._not_finite(node, math.inf, True)
            return None
        result = self._operate(node, known)
        if result is not None and not math.isfinite(result):
            if self._not_finite is not None:
                self._not_finite(node, result, _divides_by_zero(node, values))
            return None
        return result

    def _operate(self, node: ast.Expression, values: list[float]) -> float | None:
        match node:
            case ast.Number():
                return node.value
            case ast.Group() | ast.Unary(operator="+"):
                return values[0]
            case ast.Unary(operator="-"):
                return -values[0]
            case ast.Unary():
                return float(not values[0])
            case ast.Binary(operator="^"):
                return power(*values)
            case ast.Binary():
                return _chain_value(node, values)
            case ast.Comparison(operator=compare):
                return float(_COMPARE[compare](*values))
            case ast.Logic(operator="and"):
                return float(bool(values[0]) and bool(values[1]))
            case ast.Logic():
                return float(bool(values[0]) or bool(values[1]))
            case ast.Call(function=function):
                return self._call(function.text, values)
            case ast.Index() | ast.Name() | ast.Conditional() | ast.RateOf() | ast.Conversion():
                return None
            case _:
                assert_never(node)

    def _call(self, name: str, values: list[float]) -> float | None:
        declared = self._functions.get(name)
        if declared is not None:
            if len(declared.parameters) != len(values):
                return None
            return self._value(declared, values)
        return apply(name, values) if name in _ONE or name in _SEVERAL else None

    def _value(self, function: ast.FunctionStatement, values: list[float]) -> float | None:
        """The value of a declared function, computed once for the same arguments: a chain of functions that each call
        the one before twice would else take two to the power of its length."""
        call = function.name.text, tuple(values)
        if call in self._known:
            return self._known[call]
        if self._depth == DEEPEST or len(self._known) == MOST_CALLS:
            return None
        formals = dict(zip((p.text for p in function.parameters), values, strict=True))
        saved, self._not_finite = self._not_finite, None  # errors inside are reported at the call
        self._depth += 1
        try:
            value = self(function.value, formals)
        finally:
            self._depth -= 1
            self._not_finite = saved
        if len(self._known) < MOST_CALLS:
            self._known[call] = value
        return value


def _counted(node: ast.Expression) -> tuple[ast.Expression, ...]:
    """The operands that are always evaluated: for an `if`, only its condition."""
    return (node.condition,) if isinstance(node, ast.Conditional) else operands(node)


def _divides_by_zero(node: ast.Expression, values: list[float | None]) -> bool:
    """Whether a product, or `mod`, has a divisor that is the number 0, whatever its other factors are."""
    if isinstance(node, ast.Call):
        return node.function.text == "mod" and len(values) == 2 and values[1] == 0
    if not isinstance(node, ast.Binary) or node.operator not in "*/":
        return False
    return any(inverted and value == 0 for (inverted, _), value in zip(chain(node), values, strict=True))


def _chain_value(node: ast.Binary, values: list[float]) -> float:
    """The value of a sum or product, computed from left to right."""
    total = values[0]
    for (inverted, _), value in zip(chain(node)[1:], values[1:], strict=True):
        if node.operator in "+-":
            total = total - value if inverted else total + value
        elif not inverted:
            total *= value
        elif value == 0:
            return math.nan if total == 0 or math.isnan(total) else math.inf
        else:
            total /= value
    return total
