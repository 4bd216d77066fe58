"""`state`: a variable of the differential equations, or an array of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Declarator, Expression, Interval, Name, Text, UnitExpression
from gbspec.syntax.statements.base import Declaration, Entry, Place, ends, fixed
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class StateStatement(Declaration):
    """`state X : gX/L in [0, 50] = 0.1 "biomass"`."""

    entry = Entry(
        word="state",
        meaning="a variable with a balance; unit, plausible range and a guess of its initial value are optional",
        example='state X : gX/L in [0, 50] = 0.1 "biomass"',
        title="states",
        kind=Kind.STATE,
        role="state, a variable with a balance",
    )
    declarator: Declarator
    unit: UnitExpression | None = None
    range: Interval | None = None
    start: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `state NAME` and its clauses."""
        found = reader.gather(children, "a state")
        declarator: Declarator = children[1]
        if declarator.name.text in reader.words:
            reader.problem(
                "GB149",
                f"a state cannot be called `{declarator.name.text}`: its balance would begin like that statement",
                declarator.name.span,
                help="choose another name",
            )
        clauses = (found.get(kind) for kind in ("unit", "range", "value", "text"))
        return cls(reader.over(children), declarator, *clauses)

    def declares(self) -> tuple[Name, ...]:
        """The state, or the array."""
        return (self.declarator.name,)

    def places(self) -> Iterator[Place]:
        """The bounds of the indices, the initial value and the range."""
        yield from fixed(self.declarator.first, self.declarator.last, self.start)
        yield from ends(self.range)
