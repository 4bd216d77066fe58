"""`const`: a known number."""

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
class ConstStatement(Named, Formula):
    """`const B = 11`."""

    entry = Entry(
        word="const",
        meaning="a known number: an expression of other constants",
        example='const R = 8.314 "gas constant"',
        title="constants",
        symbol="Constant",
        kind=Kind.CONST,
        role="constant",
    )
    value: Expression
    unit: UnitExpression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `const NAME` and its clauses."""
        found = reader.gather(children, "a constant")
        name = reader.declared(children[1])
        message = f"the constant `{name.text}` has no value"
        help = f"write `const {name.text} = …`, or `learn {name.text} = …` if it is to be learned"
        value = reader.required(children, found, "value", message, help)
        return cls(reader.over(children), name, value, found.get("unit"), found.get("text"))

    def places(self) -> Iterator[Place]:
        """The value."""
        yield Place(self.value, rules.CONST_VALUE, self.name.text)
