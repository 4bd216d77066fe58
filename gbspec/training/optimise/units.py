"""The exponents in a unit that a model declares, by which units of constants are compared."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Learnable

NUMBER = "number"
"""The column of the logarithms of numbers in units: `1000*g` is not `g`. Columns of names begin with `name`."""
_TOKEN = re.compile(r"\s*(?:((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|([^\s\d*/^()+\-.][^\s*/^()+\-.]*)|([*/^()+-]))")


def exponents(learnables: Sequence[Learnable]) -> Array:
    """The exponents [k, d] of the units of constants; without columns where none has a unit. A unit that cannot be read
    is one of its own, that agrees with the same text alone."""
    tables = [_powers(k.unit or "1") for k in learnables]
    names = sorted({name for table in tables for name in table})
    rows = [[float(table.get(name, 0.0)) for name in names] for table in tables]
    return np.array(rows).reshape(len(tables), len(names))


def _powers(text: str) -> dict[str, float]:
    """The exponents of a unit by its columns, none of them 0."""
    try:
        return {name: power for name, power in _Reader(text).unit().items() if power}
    except (ValueError, IndexError, ArithmeticError, RecursionError):
        return {f"text {text}": 1.0}


class _Reader:
    """Reads products, quotients and powers of names and numbers, with parentheses. Raises ValueError, IndexError or
    ArithmeticError where the text is nothing of the kind."""

    def __init__(self, text: str) -> None:
        self._tokens: list[tuple[str, str, str]] = []
        end, text = 0, text.rstrip()
        while end < len(text):
            found = _TOKEN.match(text, end)
            if found is None:
                raise ValueError(text)
            self._tokens.append((found[1] or "", found[2] or "", found[3] or ""))
            end = found.end()
        self._tokens.append(("", "", "end"))
        self._next = 0

    def unit(self) -> dict[str, float]:
        """The exponents of the whole text."""
        found = self._product()
        self._take("end")
        return found

    def _product(self) -> dict[str, float]:
        out = self._power()
        while (sign := self._tokens[self._next][2]) in ("*", "/"):
            self._next += 1
            for name, power in self._power().items():
                out[name] = out.get(name, 0.0) + (power if sign == "*" else -power)
        return out

    def _power(self) -> dict[str, float]:
        number, name, sign = self._tokens[self._next]
        self._next += 1
        if number:
            found = {NUMBER: math.log(float(number))}
        elif name:
            found = {f"name {name}": 1.0}
        elif sign == "(":
            found = self._product()
            self._take(")")
        else:
            raise ValueError(sign)
        if self._tokens[self._next][2] != "^":
            return found
        self._next += 1
        exponent = self._exponent()
        return {name: power * exponent for name, power in found.items()}

    def _exponent(self) -> float:
        """A number with its sign, or one in parentheses, which may be a fraction."""
        if self._tokens[self._next][2] != "(":
            return float(self._signed())
        self._next += 1
        value = self._signed()
        if self._tokens[self._next][2] == "/":
            self._next += 1
            value /= self._signed()
        self._take(")")
        return float(value)

    def _signed(self) -> Fraction:
        sign = self._tokens[self._next][2]
        self._next += sign in ("+", "-")
        value = Fraction(self._tokens[self._next][0]).limit_denominator(1000)  # thirds are written with nine digits
        self._next += 1
        return -value if sign == "-" else value

    def _take(self, sign: str) -> None:
        if self._tokens[self._next][2] != sign:
            raise ValueError(sign)
        self._next += 1
