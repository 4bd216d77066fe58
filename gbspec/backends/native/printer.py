"""Prints expressions as C; `runtime.c` defines the functions."""

from __future__ import annotations

import sympy

from gbspec.backends.native.lookups import table_function
from gbspec.backends.printing import MUL, Printer, Text
from gbspec.ir import Lookup

LARGEST_PRODUCT = 4
"""Integer powers up to this exponent are printed as products."""


class CPrinter(Printer):
    """Prints C over the type `real`."""

    def call(self, function: str, *arguments: str) -> str:
        """`f_exp(x)`; C's operators for choices and conditions."""
        match function, arguments:
            case "where", (condition, a, b):
                return f"({condition} ? {a} : {b})"
            case "guard", (_, x):
                return f"({x})"
            case "logical_and", (a, b):
                return f"({a} && {b})"
            case "logical_or", (a, b):
                return f"({a} || {b})"
            case "logical_not", (a,):
                return f"(!({a}))"
        return f"f_{function}({', '.join(arguments)})"

    def power(self, base: sympy.Expr, exponent: sympy.Expr) -> Text:
        """Small integer powers of a symbol as products."""
        if base.is_Symbol and exponent.is_Integer and 1 < exponent <= LARGEST_PRODUCT:
            return "*".join([self.print(base)] * int(exponent)), MUL
        return self.call("power", self.print(base), self.print(exponent)), 5

    def integer(self, value: int) -> str:
        """`R(2)`."""
        return f"R({value})"

    def _number(self, node: sympy.Expr) -> Text:
        text, level = super()._number(node)
        return (f"R({text})", 5) if text[:1] in "-0123456789" and "inf" not in text else (text, level)

    def constant(self, name: str, value: sympy.Expr) -> str:
        """`R(3.14...)`, `INFINITY`, `NAN`."""
        return {"pi": f"R({float(sympy.pi)!r})", "inf": "INFINITY", "nan": "NAN"}[name]

    def lookup(self, node: Lookup) -> str:
        """`R(table_12ab34cd(x, 0))`; the last arguments are the order of the derivative."""
        return f"R({table_function(node.curve)}({', '.join([*map(self.print, node.args), *map(str, node.order)])}))"

    def truth(self, value: bool) -> str:
        """`1`, `0`."""
        return str(int(value))
