"""Symbols and applications of unknowns: the same sympy objects for a name in every expression."""

from __future__ import annotations

from functools import cache

import sympy
from sympy.core.function import AppliedUndef, UndefinedFunction
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.printer import Printer


def symbol(name: str) -> sympy.Symbol:
    """The symbol of a name, the same in every expression of a Model."""
    return sympy.Symbol(name, real=True)


@cache
def unknown_function(name: str) -> type[sympy.Function]:
    """The undefined sympy function for the unknown of that name."""
    return UndefinedFunction(name, bases=(_Unknown,), real=True)  # type: ignore[no-any-return]


class _Unknown(AppliedUndef):  # type: ignore[misc]  # sympy is untyped
    """An applied unknown. sympy finds a printer's method and a precedence by the name of a class, which is here that of
    the unknown: one that is called `Integer` must be printed as a function all the same."""

    precedence = PRECEDENCE["Func"]

    def _printed(self, printer: Printer, **options: str) -> object:
        return printer._print_Function(self, **options)

    _sympystr = _sympyrepr = _latex = _mathml_presentation = _printed
