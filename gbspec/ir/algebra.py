"""Algebraic variables of a Model, the equations that determine them, and in which order these are solved."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import sympy
from sympy.core.function import AppliedUndef

from gbspec.diagnostics import Span
from gbspec.ir.symbols import symbol

if TYPE_CHECKING:
    from gbspec.ir.model import Model, Range

Expr: TypeAlias = sympy.Expr


@dataclass(frozen=True)
class Algebraic:
    """A variable without a balance: its solution is sought from `start`, inside `range`."""

    name: str
    range: Range | None = None
    start: float | None = None
    unit: str | None = field(default=None, kw_only=True)
    description: str = field(default="", kw_only=True)
    span: Span | None = field(default=None, kw_only=True, compare=False, repr=False)

    @property
    def symbol(self) -> sympy.Symbol:
        """The symbol of the name."""
        return symbol(self.name)


@dataclass(frozen=True)
class Equation:
    """`left = right` at all times."""

    name: str
    left: Expr
    right: Expr
    description: str = field(default="", kw_only=True)
    span: Span | None = field(default=None, kw_only=True, compare=False, repr=False)

    @property
    def residual(self) -> Expr:
        """What is zero."""
        return self.right - self.left


@dataclass(frozen=True)
class EquationBlock:
    """Equations that are solved together, for as many variables; those of earlier blocks are known then.

    `explicit`: one equation that gives its variable by a formula, so that the variable is an intermediate of the Model.
    """

    equations: tuple[str, ...]
    variables: tuple[str, ...]
    explicit: bool = False


def right_sides(model: Model) -> tuple[Expr, ...]:
    """All that is evaluated along a trajectory: balances, residuals of equations, channels; intermediates inserted."""
    left = (equation.residual for equation in model.constraints)
    return model.inlined((*model.balances, *left, *(channel.value for channel in model.channels)))


def used_by_balances(model: Model) -> list[set[sympy.Symbol]]:
    """The symbols that each balance depends on, those of the equations included where it has algebraic variables."""
    left = model.inlined([equation.residual for equation in model.constraints])
    through = {symbol for residual in left for symbol in residual.free_symbols}
    solved = {item.symbol for item in model.algebraics}
    used = [set(balance.free_symbols) for balance in model.inlined(model.balances)]
    return [symbols | through if symbols & solved else symbols for symbols in used]


def unknowns_in_equations(model: Model) -> bool:
    """Whether an unknown function must be evaluated to solve for an algebraic variable."""
    if not model.algebraics:
        return False
    return any(residual.has(AppliedUndef) for residual in model.inlined([e.residual for e in model.constraints]))
