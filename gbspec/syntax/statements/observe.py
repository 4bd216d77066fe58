"""`observe`: a measured channel."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Distribution, Expression, Name, Text, UnitExpression
from gbspec.syntax.statements.base import About, Entry, Place, target_name
from gbspec.syntax.transformer import Children, ClauseRules

PREDICTION = "y"
"""The name of the prediction in a noise, beside the channel's own."""


@dataclass(frozen=True)
class ObserveStatement(About):
    """`observe y = expr : unit noise normal(0.05) as "OD 600"`; `observe X` and `observe c[3]` have no value."""

    entry = Entry(
        word="observe",
        meaning="a measured channel, a column of the data",
        example='observe y = X + S noise normal(0.05) as "OD 600" "turbidity"',
        title="measured channels",
        symbol="Field",
        kind=Kind.CHANNEL,
        role="measured channel",
        about=frozenset({Kind.STATE, Kind.LET}),
    )
    value: Expression | None = None
    unit: UnitExpression | None = None
    noise: Distribution | None = None
    column: Text | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `observe target` and its clauses."""
        found = reader.gather(children, "a channel")
        clauses = (found.get(kind) for kind in ("value", "unit", "noise", "column", "text"))
        return cls(reader.over(children), children[1], *clauses)

    def declares(self) -> tuple[Name, ...]:
        """The channel, if an expression defines it; else its name is that of the state."""
        return (self.target,) if isinstance(self.target, Name) and self.value is not None else ()

    def places(self) -> Iterator[Place]:
        """The measured expression and the parameters of its noise."""
        if self.value is not None:
            yield Place(self.value, rules.ANY)
        if self.noise is not None:
            name = target_name(self.target).text
            for argument in self.noise.arguments:
                yield Place(argument, rules.NOISE, formals=frozenset({PREDICTION, name}))
