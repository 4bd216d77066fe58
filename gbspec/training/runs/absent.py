"""Categories of conditions that the data do not have, and the constants of which nothing is learned for that reason."""

from __future__ import annotations

from collections.abc import Iterable

import sympy

from gbspec.data import Trajectories
from gbspec.ir import Expr, Model


def without_data(model: Model, data: Trajectories) -> list[str]:
    """A remark for each condition of which no trajectory has a category that a learned constant belongs to."""
    found = []
    for index, condition in enumerate(model.conditions):
        present = {int(item.condition[index]) for item in data.items}
        if not condition.categories or len(present) == len(condition.categories):
            continue
        expressions = _expressions(model)
        without = _names(expressions) - _names(
            e.xreplace({condition.symbol: sympy.Integer(number)}) for e in expressions for number in present
        )
        constants = ", ".join(f"`{k.name}`" for k in model.learnables if k.symbol in without)
        if constants:
            absent = [name for number, name in enumerate(condition.categories) if number not in present]
            listed = " or ".join(f'"{name}"' for name in absent)
            found.append(
                f"no trajectory has the `{condition.name}` {listed}, so that nothing is learned of {constants}, whose "
                "value is the start: leave such a category out, or give its constant a value (`const`) or a prior"
            )
    return found


def _expressions(model: Model) -> list[Expr]:
    """What solutions and their measurements depend on."""
    starts = [s.initial.value for s in model.states if s.initial.value is not None]
    added = [e for dose in model.doses for e in (dose.fraction, dose.lag)]
    return list(model.inlined([*model.balances, *(c.value for c in model.channels), *starts, *added]))


def _names(expressions: Iterable[Expr]) -> set[sympy.Symbol]:
    return {symbol for expression in expressions for symbol in expression.free_symbols}
