"""Values of the states at points: of those whose start is an expression, and after doses."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Expr
from gbspec.passes.identifiability.branches import evaluated
from gbspec.passes.identifiability.question import Question


def begin(question: Question, values: dict[sympy.Symbol, Array]) -> None:
    """Sets the states whose start is an expression, and adds the doses."""
    states = question.model.states
    for state, start in zip(states, question.starts, strict=True):
        if start is not None:
            values.pop(state.symbol, None)
    follow(question, values)
    for dose in question.doses:
        symbol = states[dose.state].symbol
        added = values_of(dose.fraction * dose.amount, values)
        values[before_dose(symbol)] = values[symbol]
        values[symbol] = values[symbol] + added


def before_dose(symbol: sympy.Symbol) -> sympy.Symbol:
    """The symbol of a state before a dose."""
    return sympy.Symbol(f"{symbol.name} before a dose", real=True)


def follow(question: Question, values: dict[sympy.Symbol, Array]) -> None:
    """Adds the states whose start is an expression."""
    pairs = zip(question.model.states, question.starts, strict=True)
    waiting = {state.symbol: start for state, start in pairs if start is not None}
    while waiting:
        for symbol in [s for s, e in waiting.items() if not e.free_symbols & set(waiting)]:
            values[symbol] = values_of(waiting.pop(symbol), values)


def values_of(expression: Expr, values: Mapping[sympy.Symbol, Array]) -> Array:
    """The values of an expression at all points."""
    count = len(next(iter(values.values())))
    with np.errstate(all="ignore"):  # where an expression has no value, the point is left out later
        return evaluated(values, count)(expression)[..., 0]
