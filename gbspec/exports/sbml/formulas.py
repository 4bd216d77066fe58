"""Expressions in the infix notation of SBML Level 3, which libsbml reads, and names that it allows."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

import sympy

from gbspec.backends import NotCoveredError, Printer
from gbspec.ir import Lookup

_SYMBOLS = "time avogadro pi exponentiale true false inf infinity nan notanumber"
_OPERATORS = "delay rateof and or not xor implies"
RESERVED = frozenset(f"{_SYMBOLS} {_OPERATORS}".split())
_WORDS = {"log": "ln", "maximum": "max", "minimum": "min"}


class Names:
    """Names that SBML allows: each as in the model, if it is of ASCII and not reserved, else a similar one."""

    def __init__(self, names: Iterable[str]) -> None:
        self._found: dict[str, str] = {}
        plain = [name for name in names if _allowed(name)]
        self._taken = set(plain)
        self._found.update((name, name) for name in plain)

    def __call__(self, name: str) -> str:
        """The spelling of a name."""
        if name not in self._found:
            self._found[name] = self.free(name)
        return self._found[name]

    def free(self, name: str) -> str:
        """A name that nothing has."""
        made = re.sub(r"[^A-Za-z0-9_]", "_", name).strip("_") or "x"
        made = f"_{made}" if made[0].isdigit() else made
        while made in self._taken or not _allowed(made):
            made += "_"
        self._taken.add(made)
        self._found.setdefault(made, made)
        return made


def _allowed(name: str) -> bool:
    return bool(re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name)) and name.lower() not in RESERVED


class Infix(Printer):
    """Prints expressions; `table` names the function of a table."""

    power_sign = "^"

    def __init__(self, name: Callable[[sympy.Symbol], str], table: Callable[[Lookup], str]) -> None:
        super().__init__(name)
        self._table = table

    def call(self, function: str, *arguments: str) -> str:
        """Choices, conditions, and functions; those that SBML lacks by their definitions."""
        match function, arguments:
            case "where", (condition, a, b):
                return f"piecewise({a}, {condition}, {b})"
            case "guard", (_, x):
                return f"({x})"
            case "logical_and", (a, b):
                return f"(({a}) && ({b}))"
            case "logical_or", (a, b):
                return f"(({a}) || ({b}))"
            case "logical_not", (a,):
                return f"(!({a}))"
            case "sign", (x,):
                return f"piecewise(1, ({x}) > 0, -1, ({x}) < 0, 0)"
            case "softplus", (x,):
                return f"(max({x}, 0) + ln(1 + exp(-abs({x}))))"
            case "logistic", (x,):
                return f"(1/(1 + exp(-({x}))))"
            case "atan2", _:
                raise NotCoveredError("it has `atan2`, which SBML lacks")
        return f"{_WORDS.get(function, function)}({', '.join(arguments)})"

    def power(self, base: sympy.Expr, exponent: sympy.Expr) -> tuple[str, int]:
        """`(a)^(b)`: readers differ in what binds more."""
        return f"(({self.print(base)})^({self.print(exponent)}))", 5

    def constant(self, name: str, value: sympy.Expr) -> str:
        """`pi`, `INF`, `NaN`."""
        return {"pi": "pi", "inf": "INF", "nan": "NaN"}[name]

    def lookup(self, node: Lookup) -> str:
        """A call of the table's function."""
        return f"{self._table(node)}({', '.join(map(self.print, node.args))})"

    def truth(self, value: bool) -> str:
        """`true`, `false`."""
        return "true" if value else "false"
