"""Algebraic equations that formulas solve: those that are linear in their variables."""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir import Expr, derivative

MOST_VARIABLES = 3
"""Of larger blocks the formulas, quotients of determinants, are longer than a search takes."""
MOST_OPERATIONS = 300
"""Blocks with more operations keep the search, as their formulas repeat all of them."""


def solved_by_formulas(residuals: Sequence[Expr], variables: Sequence[sympy.Symbol]) -> list[Expr]:
    """The variables of a block of equations as expressions in everything else; empty where they need a search.

    The factors of the variables may hold states, inputs and constants. Where their determinant is zero there is no
    solution, and the quotient is not finite.
    """
    if len(variables) > MOST_VARIABLES or sum(sympy.count_ops(value) for value in residuals) > MOST_OPERATIONS:
        return []
    sought = set(variables)
    if any(node.free_symbols & sought for value in residuals for node in value.atoms(AppliedUndef)):
        return []
    factors = [[derivative(value, variable) for variable in variables] for value in residuals]
    if any(factor.free_symbols & sought for row in factors for factor in row):
        return []
    rest = [value.xreplace(dict.fromkeys(variables, sympy.S.Zero)) for value in residuals]
    if any(value.has(sympy.nan, sympy.zoo, sympy.oo, -sympy.oo) for value in rest):
        return []
    matrix = sympy.Matrix(factors)
    below = matrix.det(method="berkowitz")
    if below.is_zero:
        return []
    above = -(matrix.adjugate(method="berkowitz") * sympy.Matrix(rest))
    return [value / below for value in above]
