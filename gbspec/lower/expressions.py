"""Builds sympy expressions from syntax trees.

Integers become sympy integers, decimals sympy floats of 53 bits, so that every number is printed as the double that
the user wrote. Chains of sums and products are built in one step.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import assert_never

import sympy

from gbspec.ir import Expr
from gbspec.semantics import chain, fold, operands
from gbspec.syntax import FUNCTIONS, ast

LARGEST_EXACT = 2**53
"""Larger whole numbers are not all representable as doubles, so they become floats."""

LARGEST_DOUBLE = sympy.Float(sys.float_info.max)

_EXACT_BITS = 64
"""Powers of rational numbers stay exact up to this size."""

_ELEMENTARY: dict[str, Callable[..., Expr]] = {
    **{name: getattr(sympy, name) for name in FUNCTIONS if name not in ("abs", "log10", "ceil", "mod", "min", "max")},
    "abs": sympy.Abs,
    "log10": lambda x: sympy.log(x) / sympy.log(sympy.Integer(10)),
    # One function with jumps is enough for all that follows.
    "ceil": lambda x: -sympy.floor(-x),
    "mod": lambda x, y: x - y * sympy.floor(x * power(y, sympy.S.NegativeOne)),
    "min": lambda *values: sympy.Min(*values, evaluate=False),
    "max": lambda *values: sympy.Max(*values, evaluate=False),
}

_RELATIONS: dict[str, type[sympy.Rel]] = {
    "<": sympy.StrictLessThan,
    "<=": sympy.LessThan,
    ">": sympy.StrictGreaterThan,
    ">=": sympy.GreaterThan,
    "==": sympy.Equality,
}


def number(text: str) -> Expr:
    """The value of a literal: exact for a whole number that is a double, else the nearest double."""
    if text.isdigit() and len(text) <= 16 and int(text) <= LARGEST_EXACT:
        return sympy.Integer(int(text))
    return sympy.Float(float(text))


def power(base: Expr, exponent: Expr) -> Expr:
    """`base^exponent`, without ever computing an exact number of millions of digits.

    A float exponent that is a multiple of 1/2 becomes exact, so that `x^2.0` is `x^2` and `x^0.5` is `sqrt(x)`.
    """
    if isinstance(exponent, sympy.Float) and abs(exponent) < LARGEST_EXACT and float(2 * exponent).is_integer():
        exponent = sympy.Rational(int(2 * exponent), 2)
    if exponent.is_Rational and base.is_Rational:
        bits = max(abs(base.p), base.q).bit_length()
        if abs(exponent) * bits > _EXACT_BITS:
            return sympy.Pow(sympy.Float(base), exponent)
    elif exponent.is_Rational and abs(exponent) > _EXACT_BITS:
        coefficient, rest = base.as_coeff_Mul()
        if coefficient.is_Rational and abs(coefficient) != 1:
            base = sympy.Float(coefficient) * rest
    return sympy.Pow(base, exponent)


def relation(operator: str, left: Expr, right: Expr) -> Expr:
    """A comparison; decided at once only between numbers."""
    return _RELATIONS[operator](left, right, evaluate=bool(left.is_number and right.is_number))


def conditional(condition: Expr, then: Expr, otherwise: Expr) -> Expr:
    """`if(condition, then, otherwise)`."""
    if condition in (sympy.true, sympy.false):
        return then if condition == sympy.true else otherwise
    return sympy.Piecewise((then, condition), (otherwise, True), evaluate=False)


Naming = Callable[[ast.Name], Expr]
Calling = Callable[[ast.Call, Sequence[Expr]], Expr]
Indexing = Callable[[ast.Index, Expr], Expr]


def build(node: ast.Expression, naming: Naming, calling: Calling, indexing: Indexing | None = None) -> Expr:
    """The sympy expression of a syntax tree.

    `naming`, `calling` (except elementary functions) and `indexing` (if arrays are not expanded) translate the leaves.
    """

    def combine(part: ast.Expression, values: list[Expr]) -> Expr:
        match part:
            case ast.Number(text=text):
                return number(text)
            case ast.Name():
                return sympy.pi if part.text == "pi" else naming(part)
            case ast.Group():
                return values[0]
            case ast.Unary(operator=operator):
                return {"-": lambda x: -x, "+": lambda x: x, "not": sympy.Not}[operator](values[0])
            case ast.Binary(operator="^"):
                return power(values[0], values[1])
            case ast.Binary():
                return _chain(part, values)
            case ast.Comparison(operator=operator):
                return relation(operator, values[0], values[1])
            case ast.Logic(operator=operator):
                return (sympy.And if operator == "and" else sympy.Or)(*values)
            case ast.Conditional():
                return conditional(*values)
            case ast.Call(function=function) if function.text in FUNCTIONS:
                return _ELEMENTARY[function.text](*values)
            case ast.Call():
                return calling(part, values)
            case ast.Index() if indexing is not None:
                return indexing(part, values[0])
            case ast.Index(array=array, index=ast.Number(text=text)):  # command line only: in files it is expanded
                return naming(ast.Name(part.span, f"{array.text}_{text}"))
            case ast.Index():
                return naming(ast.Name(part.span, part.array.text))
            case ast.Conversion():  # command line only, where no unit is known; the same
                return values[0]
            case ast.RateOf():  # command line only, where no name is like this
                return naming(ast.Name(part.span, part.span.text))
            case _:
                assert_never(part)

    return _presentable(fold(node, combine, parts_of))


def parts_of(node: ast.Expression) -> tuple[ast.Expression, ...]:
    """The operands of an expression that are lowered: all but the argument of `net`."""
    net = isinstance(node, ast.Call) and node.function.text == "net"
    return () if net else operands(node)


def _chain(node: ast.Binary, values: Sequence[Expr]) -> Expr:
    parts = zip(chain(node), values, strict=True)
    if node.operator in "+-":
        return sympy.Add(*(-value if inverted else value for (inverted, _), value in parts))
    return sympy.Mul(*(power(value, sympy.S.NegativeOne) if inverted else value for (inverted, _), value in parts))


def _presentable(expression: Expr) -> Expr:
    """The expression with exact numbers too long to print replaced by floats."""
    long = {
        n: sympy.Float(n) for n in expression.atoms(sympy.Rational) if max(abs(n.p), n.q).bit_length() > _EXACT_BITS
    }
    return expression.xreplace(long) if long else expression


def is_finite(expression: Expr) -> bool:
    """Whether an expression contains no infinity, no undefined or imaginary part, and no number beyond a double's.

    Products of numbers are computed exactly: `1e308*1e308` is finite for sympy.
    """
    if expression.has(sympy.zoo, sympy.nan, sympy.oo, -sympy.oo, sympy.I):
        return False
    return all(abs(n) <= LARGEST_DOUBLE for n in expression.atoms(sympy.Float))
