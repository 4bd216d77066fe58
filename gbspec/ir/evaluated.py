"""What is evaluated along a trajectory, algebraic equations included."""

from __future__ import annotations

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir.model import Expr, Model
from gbspec.ir.symbols import symbol


def right_sides(model: Model) -> tuple[Expr, ...]:
    """All that is evaluated along a trajectory: balances, residuals of equations, channels; intermediates inserted."""
    left = (equation.residual for equation in model.constraints)
    return model.inlined((*model.balances, *left, *(channel.value for channel in model.channels)))


def used_by_balances(model: Model) -> list[set[sympy.Symbol]]:
    """The symbols that each balance depends on, those of the equations included where it has algebraic variables."""
    left = model.inlined([equation.residual for equation in model.constraints])
    through = {free for residual in left for free in residual.free_symbols}
    solved = {item.symbol for item in model.algebraics}
    used = [set(balance.free_symbols) for balance in model.inlined(model.balances)]
    return [symbols | through if symbols & solved else symbols for symbols in used]


def unknowns_in_equations(model: Model) -> bool:
    """Whether an unknown function must be evaluated to solve for an algebraic variable."""
    if not model.algebraics:
        return False
    return any(residual.has(AppliedUndef) for residual in model.inlined([e.residual for e in model.constraints]))


def informative_at_start(model: Model) -> tuple[bool, ...]:
    """Whether each channel has information about what is learned at the start of a trajectory already: it contains
    a rate, a function or a constant that is learned, or a state whose initial value follows from such."""
    learned = {item.symbol for item in model.learnables}

    def tells(expression: Expr) -> bool:
        return bool(expression.free_symbols & learned) or expression.has(AppliedUndef)

    if any(tells(one) for one in model.inlined([equation.residual for equation in model.constraints])):
        learned |= {item.symbol for item in model.algebraics}
    for state in model.states:
        value = state.initial.value
        if state.initial.kind == "steady" or (value is not None and tells(value)):
            learned.add(state.symbol)
    return tuple(tells(value) for value in model.inlined([channel.value for channel in model.channels]))


def named(model: Model) -> list[tuple[Expr, Expr]]:
    """The intermediates to display, as from `Model.equations`: those that no algebraic equation gives."""
    explicit = {symbol(name) for block in model.blocks if block.explicit for name in block.variables}
    return [(left, value) for left, value in model.equations("intermediates") if left not in explicit]
