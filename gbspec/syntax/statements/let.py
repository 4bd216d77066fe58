"""`let`: a named expression."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Formula, Named, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class LetStatement(Named, Formula):
    """`let r = k*exp(-E/T)`."""

    entry = Entry(
        word="let",
        meaning="a named intermediate expression",
        example='let r : 1/s = k*exp(-E/T) "rate constant"',
        title="named expressions",
        kind=Kind.LET,
        role="named expression",
    )
    value: Expression
    unit: UnitExpression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `let NAME` and its clauses."""
        found = reader.gather(children, "`let`")
        name = reader.declared(children[1])
        message = f"`let {name.text}` has no expression"
        value = reader.required(children, found, "value", message, f"write `let {name.text} = …`")
        return cls(reader.over(children), name, value, found.get("unit"), found.get("text"))

    def places(self) -> Iterator[Place]:
        """The value."""
        yield Place(self.value, rules.ANY, self.name.text)
