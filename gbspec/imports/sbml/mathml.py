"""Formulas of SBML (its subset of MathML) as formulas of the language."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, TypeAlias

import libsbml

from gbspec.imports.computing import FACTORIAL, value_of
from gbspec.imports.formulas import (
    FALSE,
    ONE,
    PI,
    TIME,
    TRUE,
    ZERO,
    Formula,
    applied,
    as_condition,
    as_number,
    both,
    call,
    chosen,
    compared,
    either,
    named,
    negated,
    number,
    walk,
)
from gbspec.imports.sbml.pieces import exhaustive

Node: TypeAlias = Any
"""A node of libsbml, which has no types."""
AVOGADRO = 6.02214179e23
"""The value of SBML's csymbol."""


class NotOfferedError(Exception):
    """A construct that the language cannot express; its text is the reason."""


_PLAIN = {
    libsbml.AST_FUNCTION_EXP: "exp",
    libsbml.AST_FUNCTION_LN: "log",
    libsbml.AST_FUNCTION_ABS: "abs",
    libsbml.AST_FUNCTION_FLOOR: "floor",
    libsbml.AST_FUNCTION_CEILING: "ceil",
    libsbml.AST_FUNCTION_FACTORIAL: FACTORIAL,  # replaced later (`factorials`)
    libsbml.AST_FUNCTION_SIN: "sin",
    libsbml.AST_FUNCTION_COS: "cos",
    libsbml.AST_FUNCTION_TAN: "tan",
    libsbml.AST_FUNCTION_SINH: "sinh",
    libsbml.AST_FUNCTION_COSH: "cosh",
    libsbml.AST_FUNCTION_TANH: "tanh",
    libsbml.AST_FUNCTION_ARCSIN: "asin",
    libsbml.AST_FUNCTION_ARCCOS: "acos",
    libsbml.AST_FUNCTION_ARCTAN: "atan",
    libsbml.AST_FUNCTION_ARCSINH: "asinh",
    libsbml.AST_FUNCTION_ARCCOSH: "acosh",
    libsbml.AST_FUNCTION_ARCTANH: "atanh",
}
_INVERSE = {
    libsbml.AST_FUNCTION_SEC: "cos",
    libsbml.AST_FUNCTION_CSC: "sin",
    libsbml.AST_FUNCTION_COT: "tan",
    libsbml.AST_FUNCTION_SECH: "cosh",
    libsbml.AST_FUNCTION_CSCH: "sinh",
    libsbml.AST_FUNCTION_COTH: "tanh",
}
"""One over a function."""
_OF_INVERSE = {
    libsbml.AST_FUNCTION_ARCSEC: "acos",
    libsbml.AST_FUNCTION_ARCCSC: "asin",
    libsbml.AST_FUNCTION_ARCCOT: "atan",
    libsbml.AST_FUNCTION_ARCSECH: "acosh",
    libsbml.AST_FUNCTION_ARCCSCH: "asinh",
    libsbml.AST_FUNCTION_ARCCOTH: "atanh",
}
"""A function of one over its argument."""
_COMPARISONS = {
    libsbml.AST_RELATIONAL_EQ: "==",
    libsbml.AST_RELATIONAL_LT: "<",
    libsbml.AST_RELATIONAL_LEQ: "<=",
    libsbml.AST_RELATIONAL_GT: ">",
    libsbml.AST_RELATIONAL_GEQ: ">=",
}
_CONSTANTS = {
    libsbml.AST_CONSTANT_PI: PI,
    libsbml.AST_CONSTANT_E: call("exp", ONE),
    libsbml.AST_CONSTANT_TRUE: TRUE,
    libsbml.AST_CONSTANT_FALSE: FALSE,
    libsbml.AST_NAME_TIME: TIME,
    libsbml.AST_NAME_AVOGADRO: number(AVOGADRO),
}
_NOT_OFFERED = {
    libsbml.AST_FUNCTION_DELAY: "a delay is not offered yet",
    libsbml.AST_FUNCTION_RATE_OF: "`rateOf` is not offered yet",
}


def formula_of(node: Node, local: Mapping[str, str] | None = None) -> Formula:
    """The formula of a node; `local` gives names in place of others. Raises `NotOfferedError`."""
    found = _Translation(local or {}).of(node)
    if any(part.head == "number" and math.isinf(part.value) for part in walk(found)):
        raise NotOfferedError("a number that is not finite has no form in the language, but in comparisons")
    return found


class _Translation:
    def __init__(self, local: Mapping[str, str]) -> None:
        self.local = local

    def of(self, node: Node) -> Formula:
        """The formula of a node."""
        kind = node.getType()
        if kind in _NOT_OFFERED:
            raise NotOfferedError(_NOT_OFFERED[kind])
        if kind in _CONSTANTS:
            return _CONSTANTS[kind]
        if node.isNumber():
            return self._number(node)
        if kind == libsbml.AST_NAME:
            return named(self.local.get(node.getName(), node.getName()))
        parts = [self.of(node.getChild(i)) for i in range(node.getNumChildren())]
        try:
            found = self._arithmetic(kind, parts) or self._logic(kind, parts) or self._function(kind, node, parts)
        except (IndexError, ValueError, TypeError):
            raise NotOfferedError(f"`{node.getName() or kind}` has another number of arguments than it needs") from None
        if found is None:
            raise NotOfferedError(f"`{node.getName() or libsbml.formulaToL3String(node)}` has no form in the language")
        return found

    def _number(self, node: Node) -> Formula:
        kind = node.getType()
        value = float(node.getInteger()) if kind == libsbml.AST_INTEGER else float(node.getReal())
        if math.isnan(value):
            raise NotOfferedError("a number that is not finite has no form in the language")
        if kind == libsbml.AST_RATIONAL:
            return number(node.getNumerator()) / number(node.getDenominator())
        return number(value)

    def _arithmetic(self, kind: int, parts: list[Formula]) -> Formula | None:
        numbers = [as_number(part) for part in parts]
        if kind == libsbml.AST_PLUS:
            return _folded(numbers, lambda a, b: a + b, ZERO)
        if kind == libsbml.AST_TIMES:
            return _folded(numbers, lambda a, b: Formula("*", (a, b)), ONE)
        if kind == libsbml.AST_MINUS:
            return -numbers[0] if len(numbers) == 1 else Formula("-", (numbers[0], numbers[1]))
        if kind == libsbml.AST_DIVIDE:
            return Formula("/", (numbers[0], numbers[1]))
        if kind in (libsbml.AST_POWER, libsbml.AST_FUNCTION_POWER):
            return numbers[0] ** numbers[1]
        return None

    def _logic(self, kind: int, parts: list[Formula]) -> Formula | None:
        if kind in _COMPARISONS:
            pairs = pairwise(parts)
            return both([_compared(_COMPARISONS[kind], as_number(a), as_number(b)) for a, b in pairs])
        match kind:
            case libsbml.AST_RELATIONAL_NEQ:
                return negated(_compared("==", *map(as_number, parts)))
            case libsbml.AST_LOGICAL_AND:
                return both(parts)
            case libsbml.AST_LOGICAL_OR:
                return either(parts)
            case libsbml.AST_LOGICAL_NOT:
                return negated(parts[0])
            case libsbml.AST_LOGICAL_IMPLIES:
                return either([negated(parts[0]), parts[1]])
            case libsbml.AST_LOGICAL_XOR:
                return _folded(parts, lambda a, b: either([both([a, negated(b)]), both([negated(a), b])]), FALSE)
            case _:
                return None

    def _function(self, kind: int, node: Node, parts: list[Formula]) -> Formula | None:
        if kind in _PLAIN:
            return call(_PLAIN[kind], *parts)
        if kind in _INVERSE:
            return Formula("/", (ONE, call(_INVERSE[kind], *parts)))
        if kind in _OF_INVERSE:
            return call(_OF_INVERSE[kind], Formula("/", (ONE, as_number(parts[0]))))
        match kind:
            case libsbml.AST_FUNCTION_MIN | libsbml.AST_FUNCTION_MAX:
                name = "min" if kind == libsbml.AST_FUNCTION_MIN else "max"
                return as_number(parts[0]) if len(parts) == 1 else call(name, *parts)
            case libsbml.AST_FUNCTION_LOG:
                return self._logarithm(parts)
            case libsbml.AST_FUNCTION_ROOT:
                return self._root(parts)
            case libsbml.AST_FUNCTION_QUOTIENT:
                return _quotient(as_number(parts[0]), as_number(parts[1]))
            case libsbml.AST_FUNCTION_REM:
                return _remainder(as_number(parts[0]), as_number(parts[1]))
            case libsbml.AST_FUNCTION_PIECEWISE:
                return self._piecewise(parts)
            case libsbml.AST_FUNCTION:
                return applied(node.getName(), *parts)
            case _:
                return None

    def _logarithm(self, parts: list[Formula]) -> Formula:
        base, of = (number(10), parts[0]) if len(parts) == 1 else parts
        if base == number(10):
            return call("log10", of)
        return Formula("/", (call("log", of), call("log", base)))

    def _root(self, parts: list[Formula]) -> Formula:
        degree, of = (number(2), parts[0]) if len(parts) == 1 else parts
        if degree == number(2):
            return call("sqrt", of)
        return as_number(of) ** Formula("/", (ONE, as_number(degree)))

    def _piecewise(self, parts: list[Formula]) -> Formula:
        found = as_number(parts[-1]) if len(parts) % 2 else None
        conditions = [as_condition(part) for part in parts[1::2]]
        if found is None and exhaustive(conditions):
            found = as_number(parts[-2])
        for i in range(len(parts) - len(parts) % 2 - 2, -1, -2):
            condition = conditions[i // 2]
            if found is None and condition not in (TRUE, FALSE):
                raise NotOfferedError("a `piecewise` without `otherwise` has no value where no condition holds")
            if condition != FALSE:
                found = as_number(parts[i]) if found is None else chosen(condition, parts[i], found)
        if found is None:
            raise NotOfferedError("a `piecewise` without a condition that holds has no value")
        return found


def _compared(sign: str, left: Formula, right: Formula) -> Formula:
    """A comparison; one with an infinite number is decided, since every quantity is finite."""
    ends = [part.value if part.head == "number" else 0.0 for part in (left, right)]
    if any(map(math.isinf, ends)):
        return TRUE if value_of(compared(sign, *map(number, ends)), {}) else FALSE
    return compared(sign, left, right)


def _quotient(a: Formula, b: Formula) -> Formula:
    """a / b without its fraction: rounded towards 0, as MathML says."""
    ratio = Formula("/", (a, b))
    if _positive(a) and _positive(b):
        return call("floor", ratio)
    return call("sign", ratio) * call("floor", call("abs", ratio))


def _remainder(a: Formula, b: Formula) -> Formula:
    """What `quotient` leaves of a, with the sign of a."""
    if _positive(a) and _positive(b):
        return call("mod", a, b)
    return Formula("-", (a, Formula("*", (b, _quotient(a, b)))))


def _positive(formula: Formula) -> bool:
    """Whether a formula is a positive number, or the time, which begins at 0."""
    return formula == TIME or (formula.head == "number" and formula.value > 0)


def _folded(parts: list[Formula], join: Callable[[Formula, Formula], Formula], empty: Formula) -> Formula:
    """Parts joined from the left, or in halves where there are many, which keeps the tree shallow."""
    if len(parts) > 32:
        half = len(parts) // 2
        return join(_folded(parts[:half], join, empty), _folded(parts[half:], join, empty))
    if not parts:
        return empty
    found = parts[0]
    for part in parts[1:]:
        found = join(found, part)
    return found
