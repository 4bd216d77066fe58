"""Is an expression monotone in one of its symbols, whatever the others are within their intervals?

It answers yes or "not proved", like the prover of signs that it asks. The rules compose: a sum of increasing terms, a
product of factors whose signs are known, powers, increasing functions, the larger or smaller of several. They need no
derivative, so that they hold where there is none or where it has no bound: `sqrt(max(h, 0))` at `h = 0`. Where the
rules do not decide about a part, the sign of its derivative may.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import sympy

from gbspec.ir import Expr, Lookup
from gbspec.passes.intervals import INCREASING, enclosure
from gbspec.passes.signs import Prover


def monotone(prover: Prover, expression: Expr, variable: sympy.Symbol, direction: int) -> bool:
    """Whether it is proved to be non-decreasing (`direction` 1) or non-increasing (-1)."""
    if variable not in expression.free_symbols:
        return True
    if _by_rules(prover, expression, variable, direction):
        return True
    slope = prover.slope(expression, variable)
    return slope is not None and prover.nonnegative(direction * slope)


def _by_rules(prover: Prover, e: Expr, variable: sympy.Symbol, direction: int) -> bool:
    if e == variable:
        return direction > 0
    if isinstance(e, sympy.Add | sympy.Max | sympy.Min):
        return all(monotone(prover, part, variable, direction) for part in e.args)
    if isinstance(e, sympy.Mul):
        return _product(prover, e.args, variable, direction)
    if isinstance(e, sympy.Pow):
        return _power(prover, e.base, e.exp, variable, direction)
    if isinstance(e, sympy.Piecewise):
        fixed = all(variable not in condition.free_symbols for _, condition in e.args)
        return fixed and all(monotone(prover, value, variable, direction) for value, _ in e.args)
    if type(e) in INCREASING:
        return enclosure(e, prover.box) is not None and monotone(prover, e.args[0], variable, direction)
    if isinstance(e, Lookup):
        return enclosure(e, prover.box) is not None and _table(prover, e, variable, direction)
    if isinstance(e, sympy.Abs | sympy.cosh):
        side = _side(prover, e.args[0])
        return side != 0 and monotone(prover, e.args[0], variable, side * direction)
    return False


def _table(prover: Prover, e: Lookup, variable: sympy.Symbol, direction: int) -> bool:
    """Each argument that varies must go the way of the table."""
    ways = [e.curve.direction(i) for i in range(len(e.args))]
    return all(
        variable not in a.free_symbols or (way != 0 and monotone(prover, a, variable, way * direction))
        for a, way in zip(e.args, ways, strict=True)
    )


def _side(prover: Prover, expression: Expr) -> int:
    """1 if it is proved to be at least 0, -1 if at most 0, else 0."""
    if prover.nonnegative(expression):
        return 1
    return -1 if prover.nonnegative(-expression) else 0


def _product(prover: Prover, factors: Sequence[Expr], variable: sympy.Symbol, direction: int) -> bool:
    """Each factor that varies must go the way of the product, by the sign of all others."""
    varying = [i for i, factor in enumerate(factors) if variable in factor.free_symbols]
    # The sign of a factor that alone varies does not matter.
    signs = [1 if varying == [i] else _side(prover, factor) for i, factor in enumerate(factors)]
    if 0 in signs:
        return False
    # A sign is its own inverse, so that the product of the others' signs is that of all, times the factor's own.
    way = direction * math.prod(signs)
    return all(monotone(prover, factors[i], variable, way * signs[i]) for i in varying)


def _power(prover: Prover, base: Expr, exponent: Expr, variable: sympy.Symbol, direction: int) -> bool:
    if variable not in exponent.free_symbols:
        if exponent.is_Integer:
            return _integer_power(prover, base, int(exponent), variable, direction)
        if not prover.nonnegative(base):
            return False
        if prover.nonnegative(exponent):
            return monotone(prover, base, variable, direction)
        falls = prover.positive(base) and prover.nonnegative(-exponent)
        return falls and monotone(prover, base, variable, -direction)
    if variable in base.free_symbols or not prover.positive(base):
        return False
    above = _side(prover, base - 1)
    return above != 0 and monotone(prover, exponent, variable, above * direction)


def _integer_power(prover: Prover, base: Expr, n: int, variable: sympy.Symbol, direction: int) -> bool:
    """The slope of x^n is n x^(n - 1), whose sign is that of n for odd n, and also of x for even n."""
    if n > 0 and n % 2 == 1:
        return monotone(prover, base, variable, direction)
    side = 1 if prover.positive(base) else -1 if prover.positive(-base) else 0
    if n > 0 and side == 0:
        side = _side(prover, base)
    if side == 0:
        return False
    way = (1 if n > 0 else -1) * (side if n % 2 == 0 else 1)
    return monotone(prover, base, variable, way * direction)
