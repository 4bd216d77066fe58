"""Reverse derivatives of single operations, the same as torch takes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import sympy
from sympy.logic.boolalg import Boolean

from gbspec.backends.native.flat import NotCoveredError, Operation
from gbspec.backends.printing.nodes import Guard, Where
from gbspec.ir.forms import logistic, softplus
from gbspec.ir.model import Expr

Contribution = tuple[sympy.Symbol, Expr]

# With x the argument and v the value.
UNARY: Mapping[type[sympy.Basic], Callable[[Expr, Expr], Expr]] = {
    sympy.exp: lambda x, v: v,
    sympy.log: lambda x, v: 1 / x,
    sympy.sin: lambda x, v: sympy.cos(x),
    sympy.cos: lambda x, v: -sympy.sin(x),
    sympy.tan: lambda x, v: 1 + v**2,
    sympy.tanh: lambda x, v: 1 - v**2,
    sympy.sinh: lambda x, v: sympy.cosh(x),
    sympy.cosh: lambda x, v: sympy.sinh(x),
    sympy.asin: lambda x, v: 1 / sympy.sqrt(1 - x**2),
    sympy.acos: lambda x, v: -1 / sympy.sqrt(1 - x**2),
    sympy.atan: lambda x, v: 1 / (1 + x**2),
    sympy.asinh: lambda x, v: 1 / sympy.sqrt(1 + x**2),
    sympy.acosh: lambda x, v: 1 / sympy.sqrt(x**2 - 1),
    sympy.atanh: lambda x, v: 1 / (1 - x**2),
    sympy.Abs: lambda x, v: sympy.sign(x),
    softplus: lambda x, v: logistic(x),
    logistic: lambda x, v: v * (1 - v),
}


def contributions(operation: Operation, bar: sympy.Symbol) -> list[Contribution]:
    """What the operation adds to the cotangents of its arguments, `bar` being the cotangent of its value."""
    return [(symbol, term) for symbol, term in _terms(operation, bar) if isinstance(symbol, sympy.Symbol)]


def _terms(operation: Operation, bar: sympy.Symbol) -> list[tuple[sympy.Basic, Expr]]:
    node, v = operation.value, operation.symbol
    if isinstance(node, Boolean | sympy.sign):
        return []
    if type(node) in UNARY:
        return [(node.args[0], bar * UNARY[type(node)](node.args[0], v))]
    match node:
        case sympy.Add():
            return [(a, bar) for a in node.args]
        case sympy.Mul():
            others = [node.args[:i] + node.args[i + 1 :] for i in range(len(node.args))]
            return [(a, sympy.Mul(bar, *rest, evaluate=False)) for a, rest in zip(node.args, others, strict=True)]
        case sympy.Pow():
            return _power(node, v, bar)
        case sympy.Max() | sympy.Min():
            a, b = _operands(node)
            loses = (a < b, b < a) if isinstance(node, sympy.Max) else (b < a, a < b)
            tie = Where(sympy.Eq(a, b, evaluate=False), bar / 2, bar)
            return [(x, Where(lost, sympy.S.Zero, tie)) for x, lost in zip((a, b), loses, strict=True)]
        case sympy.atan2():
            y, x = node.args
            square = 1 / (x**2 + y**2)
            return [(y, bar * x * square), (x, -bar * y * square)]
        case Where():
            condition, a, b = node.args
            return [(a, Where(condition, bar, sympy.S.Zero)), (b, Where(condition, sympy.S.Zero, bar))]
        case Guard():
            condition, a = node.args
            return [(a, Where(condition, bar, sympy.S.Zero))]
    raise NotCoveredError(f"it has no derivative for `{type(node).__name__}`")


def _operands(node: sympy.Basic) -> tuple[Expr, Expr]:
    """The two arguments of Max and Min, which sympy keeps as a set; with equal ones there is but one."""
    ordered = sorted(node.args, key=sympy.default_sort_key)
    return ordered[0], ordered[-1]


def _power(node: sympy.Pow, v: sympy.Symbol, bar: sympy.Symbol) -> list[tuple[sympy.Basic, Expr]]:
    base, exponent = node.args
    if exponent == -1:
        return [(base, -bar * v * v)]
    if exponent == sympy.Rational(1, 2):
        return [(base, bar / (2 * v))]
    slope = bar * exponent * sympy.Pow(base, exponent - 1)
    if exponent.is_number:
        return [(base, slope)]
    zero = sympy.S.Zero
    flat = Where(sympy.Eq(exponent, 0, evaluate=False), zero, slope)
    growth = bar * v * sympy.log(base)
    dead = sympy.And(sympy.Eq(base, 0, evaluate=False), sympy.Ge(exponent, 0, evaluate=False), evaluate=False)
    return [(base, flat), (exponent, Where(dead, zero, growth) if base.is_Symbol else growth)]
