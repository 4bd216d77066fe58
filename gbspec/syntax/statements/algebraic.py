"""`algebraic`: a variable without a balance, which equations determine, or an array of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Declarator, Expression, Interval, Name, Text, UnitExpression
from gbspec.syntax.statements.base import Declaration, Entry, Place, ends, fixed
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class AlgebraicStatement(Declaration):
    """`algebraic T : K in [280, 400] = 300 "temperature of the jacket"`."""

    entry = Entry(
        word="algebraic",
        meaning="a variable without a balance, which equations determine; where its solution is sought and begins",
        example='algebraic T : K in [280, 400] = 300 "temperature"',
        title="algebraic variables",
        kind=Kind.ALGEBRAIC,
        role="algebraic variable, which an equation determines",
        reserved=False,
    )
    declarator: Declarator
    unit: UnitExpression | None = None
    range: Interval | None = None
    start: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `algebraic NAME` and its clauses."""
        found = reader.gather(children, "an algebraic variable")
        clauses = (found.get(kind) for kind in ("unit", "range", "value", "text"))
        return cls(reader.over(children), children[1], *clauses)

    def declares(self) -> tuple[Name, ...]:
        """The variable, or the array."""
        return (self.declarator.name,)

    def places(self) -> Iterator[Place]:
        """The bounds of the indices, the value from which the solution is sought, and the range."""
        yield from fixed(self.declarator.first, self.declarator.last, self.start)
        yield from ends(self.range)
