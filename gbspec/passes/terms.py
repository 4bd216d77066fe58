"""Right sides as sums of terms, each a constant coefficient times a varying factor; unknowns stay symbols."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import product

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir import Expr, Model

MOST_TERMS = 2000
"""A product of sums that would have more terms than this is not expanded."""


BRANCHES = (sympy.Piecewise, sympy.Abs, sympy.Min, sympy.Max, sympy.sign, sympy.floor)
"""Functions that have another formula on each side of a boundary."""


def branching(expression: Expr) -> list[Expr]:
    """The parts of an expression that have branches, in a fixed order."""
    return sorted(expression.atoms(*BRANCHES), key=sympy.default_sort_key)


def exact(expression: Expr) -> Expr:
    """The expression with every float as its exact decimal fraction, so that sums cancel exactly."""
    floats = expression.atoms(sympy.Float)
    return expression.xreplace({f: sympy.Rational(repr(float(f))) for f in floats}) if floats else expression


def larger_than(model: Model, most: int) -> bool:
    """Whether balances and intermediates have more than `most` nodes together (sympy's own count is slow)."""
    waiting: list[sympy.Basic] = [*model.balances, *(item.value for item in model.intermediates)]
    waiting += [equation.residual for equation in model.constraints]
    for _ in range(most):
        if not waiting:
            return False
        waiting.extend(waiting.pop().args)
    return bool(waiting)


def term_count(expression: Expr) -> int:
    """The number of terms of an expression after expanding its products (but not powers of sums)."""
    if expression.is_Add:
        return sum(term_count(part) for part in expression.args)
    if expression.is_Mul:
        count = 1
        for part in expression.args:
            count *= term_count(part)
            if count > MOST_TERMS:
                return count
        return count
    return 1


def terms(expression: Expr) -> list[Expr]:
    """The terms of an expression with its products of sums expanded, unless they are too many.

    (`sympy.expand_mul` also multiplies out denominators, after which equal terms need not look equal.)
    """
    if term_count(expression) > MOST_TERMS:
        return list(sympy.Add.make_args(expression))
    if expression.is_Add:
        return [term for part in expression.args for term in terms(part)]
    if expression.is_Mul and any(part.is_Add for part in expression.args):
        return [term for choice in product(*map(terms, expression.args)) for term in _again(sympy.Mul(*choice))]
    return [expression]


def _again(term: Expr) -> list[Expr]:
    """The terms of a product that sympy has expanded to a sum, such as `2*(a + b)`."""
    return terms(term) if term.is_Add else [term]


@dataclass
class Opened:
    """Expressions in which each distinct application of an unknown is replaced by its own free symbol.

    `applications` maps them; those whose arguments are all constant are constant themselves.
    """

    constants: frozenset[sympy.Symbol]
    applications: dict[Expr, sympy.Dummy] = field(default_factory=dict)
    fixed: set[sympy.Dummy] = field(default_factory=set)

    def open(self, expression: Expr) -> Expr:
        """The expression, exact, with applications replaced."""
        expression = exact(expression)
        found = expression.atoms(AppliedUndef)
        if not found:
            return expression
        for application in sorted(found, key=sympy.default_sort_key):
            if application not in self.applications:
                dummy = sympy.Dummy(application.func.__name__, real=True)
                self.applications[application] = dummy
                if application.free_symbols <= self.constants:
                    self.fixed.add(dummy)
        return expression.xreplace(self.applications)

    def close(self, expression: Expr) -> Expr:
        """The expression with applications substituted for their symbols."""
        return expression.xreplace({dummy: application for application, dummy in self.applications.items()})

    def split(self, expression: Expr) -> dict[Expr, Expr]:
        """Coefficients (of constants only) by varying factor; constant terms have the key 1."""
        table: dict[Expr, list[Expr]] = {}
        constant = self.constants | self.fixed
        for term in terms(expression):
            factors = sympy.Mul.make_args(term)
            coefficient = [f for f in factors if f.free_symbols <= constant]
            varying = [f for f in factors if not f.free_symbols <= constant]
            table.setdefault(sympy.Mul(*varying), []).append(sympy.Mul(*coefficient))
        sums = {key: sympy.Add(*values) for key, values in table.items()}
        return {key: value for key, value in sums.items() if value != 0}


def constants_of(model: Model) -> frozenset[sympy.Symbol]:
    """Symbols that do not vary within a trajectory: constants, learnables and conditions."""
    names: Iterable[sympy.Symbol] = (
        *(c.symbol for c in model.constants),
        *(k.symbol for k in model.learnables),
        *(c.symbol for c in model.conditions),
    )
    return frozenset(names)
