"""The common printer of expressions: each kind of sympy node has one rule, each target language one small subclass.

sympy's own code printers are not used: they cut floats to 15 digits and differ from each other in what they support.
Nothing is simplified or expanded; the text evaluates to the value of the expression up to rounding.
"""

from __future__ import annotations

import functools
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import ClassVar

import sympy
from sympy.core.relational import Relational
from sympy.logic.boolalg import BooleanAtom

from gbspec.backends.printing.nodes import Guard, Operation, Where
from gbspec.diagnostics import Defect
from gbspec.ir import Element, Lookup, Total, logistic, ordered, softplus

OR, ADD, MUL, NEGATIVE, POWER, ATOM = range(6)
"""Precedence of a text, lowest first."""

UNARY: Mapping[type[sympy.Basic], str] = {
    sympy.exp: "exp",
    sympy.log: "log",
    sympy.sin: "sin",
    sympy.cos: "cos",
    sympy.tan: "tan",
    sympy.tanh: "tanh",
    sympy.sinh: "sinh",
    sympy.cosh: "cosh",
    sympy.asin: "asin",
    sympy.acos: "acos",
    sympy.atan: "atan",
    sympy.asinh: "asinh",
    sympy.acosh: "acosh",
    sympy.atanh: "atanh",
    sympy.Abs: "abs",
    sympy.sign: "sign",
    sympy.floor: "floor",
    softplus: "softplus",
    logistic: "logistic",
}
"""Functions of one argument, and their names in a target's arithmetic."""

RECIPROCAL: Mapping[type[sympy.Basic], str] = {sympy.cot: "tan", sympy.sec: "cos", sympy.csc: "sin"}
"""Functions that sympy makes of shifted arguments, such as tan(x + pi/2) = -cot(x)."""

RELATIONS: Mapping[str, str] = {"<": "<", "<=": "<=", ">": ">", ">=": ">=", "==": "==", "!=": "!="}

_NO_NUMBERS = (sympy.Symbol, sympy.core.function.AppliedUndef, Where, Guard, Operation)
"""Nodes that sympy cannot convert to a number even if they contain no symbols."""

LARGEST_EXACT = 2**53
"""Larger integers are written as floats: they denote float64 numbers anyway, and torch rejects long integers."""

_NESTED = 8
"""Maxima and minima of more arguments are halved before they are nested."""

Text = tuple[str, int]
"""A text and its precedence."""


class Printer(ABC):
    """Prints expressions; `name` maps a symbol to its text."""

    power_sign: ClassVar[str] = "**"

    def __init__(self, name: Callable[[sympy.Symbol], str]) -> None:
        self.name = name

    @abstractmethod
    def call(self, function: str, *arguments: str) -> str:
        """The text of a call of a function of the target's arithmetic."""

    def print(self, node: sympy.Basic) -> str:
        """The text of an expression or a condition."""
        return self._text(node)[0]

    def at(self, node: sympy.Basic, level: int) -> str:
        """The text of a node, in parentheses if its precedence is below `level`."""
        text, binding = self._text(node)
        return text if binding >= level else f"({text})"

    def _text(self, node: sympy.Basic) -> Text:
        if isinstance(node, sympy.Expr) and not node.has(*_NO_NUMBERS):
            return self._number(node)
        match node:
            case sympy.Symbol():
                return self.name(node), ATOM
            case sympy.Add():
                return self._sum(node), ADD
            case sympy.Mul():
                return self._product(node)
            case sympy.Pow():
                return self._power(node)
            case sympy.Max() | sympy.Min():
                return self._extremum(node), ATOM
            case sympy.Piecewise():
                return self._piecewise(node), ATOM
            case Where() | Guard() | Operation():
                return self.call(node.word, *map(self.print, node.args)), ATOM
            case sympy.atan2():
                return self.call("atan2", *map(self.print, node.args)), ATOM
            case Relational() | sympy.And() | sympy.Or() | sympy.Not() | sympy.ITE() | BooleanAtom():
                return self._condition(node)
            case Lookup():
                return self.lookup(node), ATOM
            case sympy.core.function.AppliedUndef() | Element() | Total():
                return self.application(node), ATOM
        kind = type(node)
        if kind in UNARY:
            return self.call(UNARY[kind], self.print(node.args[0])), ATOM
        if kind in RECIPROCAL:
            return f"1/{self.call(RECIPROCAL[kind], self.print(node.args[0]))}", MUL
        raise Defect(f"no rule prints the node {kind.__name__} in `{node}`")

    def application(self, node: sympy.Basic) -> str:
        """An application of an unknown, an element or a total; for most targets they are replaced before printing."""
        raise Defect(f"`{node}` was not replaced before printing")

    @abstractmethod
    def lookup(self, node: Lookup) -> str:
        """An application of a table, or of its derivative."""

    # -------------------------------------------------------------- numbers
    def _number(self, node: sympy.Expr) -> Text:
        if isinstance(node, sympy.Rational):
            return self._rational(node)
        if node is sympy.S.Pi:
            return self.constant("pi", sympy.pi), ATOM
        if node in (sympy.oo, -sympy.oo, sympy.nan):
            text = self.constant("nan" if node is sympy.nan else "inf", node)
            return (f"-{text}", NEGATIVE) if node == -sympy.oo else (text, ATOM)
        value = sympy.N(node, 17 if isinstance(node, sympy.Float) else 30)
        if not value.is_Float and not value.is_Integer:
            raise Defect(f"`{node}` is not a real number")
        text = repr(float(value))
        return text, NEGATIVE if text.startswith("-") else ATOM

    def _rational(self, node: sympy.Rational) -> Text:
        numerator, denominator = int(node.p), int(node.q)
        if max(abs(numerator), denominator) > LARGEST_EXACT:
            text = repr(numerator / denominator)
        else:
            text = self.integer(numerator) if denominator == 1 else f"{self.integer(numerator)}/{denominator}"
        level = ATOM if denominator == 1 or "/" not in text else MUL
        return text, min(level, NEGATIVE) if text.startswith("-") else level

    def integer(self, value: int) -> str:
        """The text of an integer."""
        return str(value)

    @abstractmethod
    def constant(self, name: str, value: sympy.Expr) -> str:
        """The text of pi, inf or nan."""

    # -------------------------------------------------------------- sums, products, powers
    def _sum(self, node: sympy.Add) -> str:
        terms = [self._signed(term) for term in node.as_ordered_terms()]
        # A sum begins with its first positive term, if it has one: `u_f - u` rather than `-u + u_f`.
        first = next((i for i, (negative, _) in enumerate(terms) if not negative), 0)
        text = ""
        for negative, size in (terms[first], *terms[:first], *terms[first + 1 :]):
            text += f" {'-' if negative else '+'} {size}" if text else f"-{size}" if negative else size
        return text

    def _signed(self, term: sympy.Expr) -> tuple[bool, str]:
        """Whether a term has a minus sign, and its text without it."""
        coefficient, rest = term.as_coeff_Mul()
        if not coefficient.is_negative:
            return False, self.at(term, MUL)
        return True, self._quotient([-coefficient, *sympy.Mul.make_args(rest)])

    def _product(self, node: sympy.Mul) -> Text:
        negative, size = self._signed(node) if node.as_coeff_Mul()[0].is_negative else (False, "")
        return (f"-{size}", MUL) if negative else (self._quotient(node.as_ordered_factors()), MUL)

    def _quotient(self, factors: Iterable[sympy.Expr]) -> str:
        """The product of factors as one fraction."""
        above: list[str] = []
        below: list[sympy.Expr] = []
        for factor in factors:
            if isinstance(factor, sympy.Rational) and abs(factor.p) <= LARGEST_EXACT and factor.q <= LARGEST_EXACT:
                if factor.p != 1:
                    above.append(self.integer(int(factor.p)))
                if factor.q != 1:
                    below.append(sympy.Integer(factor.q))
            elif isinstance(factor, sympy.Pow) and factor.exp.is_Rational and factor.exp.is_negative:
                below.append(self._inverse(factor))
            else:
                above.append(self.at(factor, MUL if not above else NEGATIVE))
        numerator = "*".join(above) or self.integer(1)
        if not below:
            return numerator
        if len(below) == 1:
            return f"{numerator}/{self.at(below[0], POWER)}"
        return f"{numerator}/({'*'.join(self.at(factor, NEGATIVE) for factor in below)})"

    @staticmethod
    def _inverse(power: sympy.Pow) -> sympy.Expr:
        return power.base if power.exp == -1 else sympy.Pow(power.base, -power.exp, evaluate=False)

    def _power(self, node: sympy.Pow) -> Text:
        base, exponent = node.base, node.exp
        if exponent == sympy.Rational(1, 2):
            return self.call("sqrt", self.print(base)), ATOM
        if exponent.is_Rational and exponent.is_negative:
            return f"{self.integer(1)}/{self.at(self._inverse(node), POWER)}", MUL
        return self.power(base, exponent)

    def power(self, base: sympy.Expr, exponent: sympy.Expr) -> Text:
        """A power that is neither a root nor a reciprocal."""
        return f"{self.at(base, ATOM)}{self.power_sign}{self.at(exponent, POWER)}", POWER

    # -------------------------------------------------------------- choices
    def _extremum(self, node: sympy.Basic) -> str:
        word = "maximum" if isinstance(node, sympy.Max) else "minimum"
        return self._balanced(word, [self.print(argument) for argument in ordered(node)])

    def _balanced(self, word: str, texts: Sequence[str]) -> str:
        """Calls with two arguments, nested as little as possible: compilers limit the depth of parentheses."""
        if len(texts) <= _NESTED:
            return functools.reduce(lambda text, argument: self.call(word, text, argument), texts)
        middle = len(texts) // 2
        return self.call(word, self._balanced(word, texts[:middle]), self._balanced(word, texts[middle:]))

    def _piecewise(self, node: sympy.Piecewise) -> str:
        text = self.constant("nan", sympy.nan)
        for value, condition in reversed(node.args):
            if condition == sympy.true:
                text = self.print(value)
            else:
                text = self.call("where", self.print(condition), self.print(value), text)
        return text

    def _condition(self, node: sympy.Basic) -> Text:
        match node:
            case Relational():
                return f"{self.at(node.lhs, ADD)} {RELATIONS[node.rel_op]} {self.at(node.rhs, ADD)}", OR
            case sympy.Not():
                return self.call("logical_not", self.print(node.args[0])), ATOM
            case sympy.ITE():  # sympy's form of a comparison with a Piecewise
                condition, then, otherwise = map(self.print, node.args)
                taken = self.call("logical_and", condition, then)
                left = self.call("logical_and", self.call("logical_not", condition), otherwise)
                return self.call("logical_or", taken, left), ATOM
            case sympy.And() | sympy.Or():
                word = "logical_and" if isinstance(node, sympy.And) else "logical_or"
                first, *rest = ordered(node)
                text = self.print(first)
                for argument in rest:
                    text = self.call(word, text, self.print(argument))
                return text, ATOM
        return self.truth(node == sympy.true), ATOM

    @abstractmethod
    def truth(self, value: bool) -> str:
        """The text of true or false."""


class PythonPrinter(Printer):
    """Prints Python over an arithmetic namespace called `math`, the same text for torch, casadi and numpy."""

    def call(self, function: str, *arguments: str) -> str:
        """`math.exp(x)`."""
        return f"math.{function}({', '.join(arguments)})"

    def constant(self, name: str, value: sympy.Expr) -> str:
        """`math.pi`."""
        return f"math.{name}"

    def lookup(self, node: Lookup) -> str:
        """`_lookup("ocv", soc)`, a function of the module."""
        order = f", order={node.order!r}" if any(node.order) else ""
        return f"_lookup({json.dumps(node.table, ensure_ascii=False)}, {', '.join(map(self.print, node.args))}{order})"

    def truth(self, value: bool) -> str:
        """`True`."""
        return str(value)


class TextPrinter(Printer):
    """Prints the notation of a `.gb` file, for docstrings: the user's names, `^`, unknowns with their arguments."""

    power_sign = "^"
    words: ClassVar[Mapping[str, str]] = {"maximum": "max", "minimum": "min", "where": "if"}

    def __init__(self) -> None:
        super().__init__(lambda symbol: str(symbol.name))

    def call(self, function: str, *arguments: str) -> str:
        """`exp(x)`; conditions in words."""
        match function, arguments:
            case "logical_and", (a, b):
                return f"({a} and {b})"
            case "logical_or", (a, b):
                return f"({a} or {b})"
            case "logical_not", (a,):
                return f"(not {a})"
        return f"{self.words.get(function, function)}({', '.join(arguments)})"

    def application(self, node: sympy.Basic) -> str:
        """`phi(x1, x2)`, `c[i - 1]`, `sum(c)`."""
        if isinstance(node, Element):
            return f"{node.args[0]}[{self.print(node.args[1])}]"
        if isinstance(node, Total):
            return f"sum({node.args[0]})"
        return f"{node.func.__name__}({', '.join(map(self.print, node.args))})"

    def lookup(self, node: Lookup) -> str:
        """`ocv(soc)`; a derivative, which no text of a user has, with marks."""
        return str(node)

    def constant(self, name: str, value: sympy.Expr) -> str:
        """`pi`."""
        return name

    def truth(self, value: bool) -> str:
        """`true`, which never occurs in a `.gb` text."""
        return str(value).lower()
