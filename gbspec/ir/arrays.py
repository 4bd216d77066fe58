"""Arrays of states, and expressions that represent all elements of an array at once.

A Model has an entry for every single state, balance, initial value and channel, and analysis works on these. If the
text has one expression for all elements of an array, or sums them, a `Family` stores that short form in addition, so
that backends can compute whole arrays in one operation. Both forms come from the same text.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import sympy

from gbspec.diagnostics import Defect
from gbspec.ir.forms import Expr

Vector = Literal["balances", "starts", "channels", "intermediates"]
"""The tuples of a Model whose entries a family can represent."""


class Element(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """`c[i - 1]`: an element of an array; the index is linear in the family's running index."""

    is_real = True

    def __new__(cls, array: sympy.Symbol, index: Expr) -> Element:
        """Takes the array's name as a symbol, and the index."""
        return super().__new__(cls, array, index)  # type: ignore[no-any-return]


class Total(sympy.Expr):  # type: ignore[misc]  # sympy is untyped
    """`sum(c)`: the sum of all elements of an array."""

    is_real = True

    def __new__(cls, array: sympy.Symbol) -> Total:
        """Takes the array's name as a symbol."""
        return super().__new__(cls, array)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class StateArray:
    """`state c[1..512]`: its first index, the names of its states, the position of the first of them among the
    Model's states, and the expressions of elements beyond its ends, by index."""

    name: str
    first: int
    names: tuple[str, ...]
    position: int
    ends: tuple[tuple[int, Expr], ...] = ()

    @property
    def count(self) -> int:
        """Number of elements."""
        return len(self.names)

    @property
    def last(self) -> int:
        """The index of the last element."""
        return self.first + len(self.names) - 1

    @property
    def symbol(self) -> sympy.Symbol:
        """The array in `Element` and `Total`."""
        return sympy.Symbol(self.name, real=True)

    @property
    def range(self) -> str:
        """`c[1..512]`."""
        return f"{self.name}[{self.first}..{self.last}]"

    def at(self, index: int) -> Expr:
        """The expression of an element: the symbol of a state, or beyond the range that of its closure."""
        if self.first <= index <= self.last:
            return sympy.Symbol(self.names[index - self.first], real=True)
        for where, value in self.ends:
            if where == index:
                return value
        raise Defect(f"`{self.name}[{index}]` is neither a state nor closed by an equation")


@dataclass(frozen=True)
class Family:
    """One expression for the entries `begin` to `begin + count - 1` of one of the Model's vectors.

    The running index `index` is `first` in the first of them, and one more in each that follows. With `index` None the
    family is a single entry whose expression holds totals.
    """

    vector: Vector
    begin: int
    count: int
    value: Expr
    index: sympy.Symbol | None = None
    first: int = 0
    array: str = ""


def runs(families: Sequence[Family], vector: Vector, size: int) -> Iterator[Family | int]:
    """The entries of a vector of that size in order: families, and positions of single entries."""
    starts = {family.begin: family for family in families if family.vector == vector}
    place = 0
    while place < size:
        family = starts.get(place)
        yield place if family is None else family
        place += 1 if family is None else family.count
