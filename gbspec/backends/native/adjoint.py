"""Reverse derivatives of single operations: the rules of `gbspec.ir.derivatives`, multiplied by a cotangent."""

from __future__ import annotations

import sympy
from sympy.logic.boolalg import Boolean

from gbspec.backends.native.flat import Operation
from gbspec.backends.printing import Guard, Where
from gbspec.ir import Expr, partials

Contribution = tuple[sympy.Symbol, Expr]


def contributions(operation: Operation, bar: sympy.Symbol) -> list[Contribution]:
    """The operation's contributions to the cotangents of its arguments; `bar` is the cotangent of its value."""
    found = [(symbol, term) for symbol, term in _terms(operation, bar) if isinstance(symbol, sympy.Symbol)]
    return [(symbol, term) for symbol, term in found if term != 0]


def _terms(operation: Operation, bar: sympy.Symbol) -> list[tuple[sympy.Basic, Expr]]:
    node, zero = operation.value, sympy.S.Zero
    match node:
        case Boolean():
            return []
        case Where():
            condition, a, b = node.args
            return [(a, Where(condition, bar, zero)), (b, Where(condition, zero, bar))]
        case Guard():
            condition, a = node.args
            return [(a, Where(condition, bar, zero))]
    return [(a, _times(bar, slope)) for a, slope in partials(node, operation.symbol)]


def _times(bar: sympy.Symbol, slope: Expr) -> Expr:
    """The product, taken inside the branches of a choice: 0 times an infinite or NaN cotangent is NaN."""
    if not isinstance(slope, sympy.Piecewise):
        return sympy.Mul(bar, *slope.args, evaluate=False) if isinstance(slope, sympy.Mul) else bar * slope
    *cases, (otherwise, _) = slope.args
    result = _times(bar, otherwise)
    for value, condition in reversed(cases):
        result = Where(condition, _times(bar, value), result)
    return result
