"""Algebraic variables of a Model, the equations that determine them, and in which order these are solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import sympy

from gbspec.ir.declared import Declared, Range

Expr: TypeAlias = sympy.Expr


@dataclass(frozen=True)
class Algebraic(Declared):
    """A variable without a balance: its solution is sought from `start`, inside `range`."""

    range: Range | None = None
    start: float | None = None


@dataclass(frozen=True)
class Equation(Declared):
    """`left = right` at all times."""

    left: Expr = sympy.S.Zero
    right: Expr = sympy.S.Zero

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
