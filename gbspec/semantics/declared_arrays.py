"""Arrays of states and rows of learnable constants, as they are declared."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from gbspec.diagnostics import Span
from gbspec.semantics.merge import Item
from gbspec.syntax import ast


@dataclass
class DeclaredArray:
    """A declared array: its range of indices, and the expressions for elements beyond its ends.

    `row`: of constants, which has no balances and no ends.
    """

    name: str
    span: Span
    first: int
    last: int
    row: bool = False
    ends: dict[int, ast.ClosureStatement] = field(default_factory=dict)

    @property
    def range(self) -> str:
        """`1 to 512`."""
        return f"{self.first} to {self.last}"

    def element(self, index: int) -> str:
        """The name of the state or constant for an element."""
        return f"{self.name}_{index}" if index >= 0 else f"{self.name}_m{-index}"

    @property
    def elements(self) -> tuple[str, ...]:
        """The names of all elements."""
        return tuple(self.element(i) for i in range(self.first, self.last + 1))


@dataclass(frozen=True)
class Declared:
    """The declaration of an array: its name, and the two ends of its indices."""

    name: ast.Name
    span: Span
    ends: tuple[ast.Expression, ast.Expression]
    row: bool = False


def declarations(items: tuple[Item, ...]) -> Iterator[Declared]:
    """The arrays that a model declares."""
    for item in items:
        match item.statement:
            case ast.StateStatement(
                declarator=ast.Declarator(name=name, first=ast.Node() as first, last=ast.Node() as last)
            ):
                yield Declared(name, item.statement.declarator.span, (first, last))
            case ast.LearnStatement(name=name, row=(first, last)):
                yield Declared(name, name.span.to(last.span), (first, last), row=True)
            case _:
                pass
