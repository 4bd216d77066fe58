"""`discrete`: a value that holds until an event changes it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Interval, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Formula, Named, Place, ends
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class DiscreteStatement(Named, Formula):
    """`discrete on = 0`."""

    entry = Entry(
        word="discrete",
        meaning="a value that holds until an event changes it",
        example='discrete on = 0 "heater"',
        title="states",
        kind=Kind.STATE,
        role="value that only events change",
        reserved=False,
    )
    value: Expression
    unit: UnitExpression | None = None
    range: Interval | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `discrete NAME` and its clauses."""
        found = reader.gather(children, "a discrete value")
        name = reader.declared(children[1])
        message = f"the discrete value `{name.text}` does not say where it begins"
        value = reader.required(children, found, "value", message, f"write `discrete {name.text} = 0`")
        return cls(reader.over(children), name, value, found.get("unit"), found.get("range"), found.get("text"))

    def places(self) -> Iterator[Place]:
        """The value at the start, and the range."""
        yield Place(self.value, rules.START)
        yield from ends(self.range)
