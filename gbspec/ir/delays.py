"""Delays of a Model: values of a time ago, which equations see as one symbol each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import sympy

from gbspec.diagnostics import Span
from gbspec.ir.symbols import symbol, unknown_function


@dataclass(frozen=True)
class Delay:
    """`source`, a state, an input or an intermediate, the time `lag` ago: an expression of constants and conditions.

    `name` is the text of its symbol, which no declared name can have. `least` is the shortest time that the bounds of
    the constants allow, without what conditions do: those are known with the data.
    """

    name: str
    source: str
    lag: sympy.Expr
    least: float = 0.0
    span: Span | None = field(default=None, kw_only=True, compare=False, repr=False)

    @property
    def symbol(self) -> sympy.Symbol:
        """The symbol of its value in equations."""
        return symbol(self.name)

    @property
    def value(self) -> sympy.Symbol:
        """The symbol of what is delayed."""
        return symbol(self.source)


def timed(expression: sympy.Expr, delays: Iterable[Delay], time: sympy.Symbol) -> sympy.Expr:
    """The expression with delayed values as their quantities at an earlier time, for display."""
    times = {d: sympy.Add(time, -d.lag, evaluate=False) for d in delays}
    return expression.xreplace({d.symbol: unknown_function(d.source)(at) for d, at in times.items()})
