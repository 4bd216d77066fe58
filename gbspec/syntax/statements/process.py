"""`process`: a conversion of states at a rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Text
from gbspec.syntax.statements.base import Entry, Formula, Named, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class ProcessStatement(Named, Formula):
    """`process growth: 1/Y*S -> X rate mu(S)*X`; an empty side is None."""

    entry = Entry(
        word="process",
        meaning="a conversion of states at a rate; its name in an expression is its rate",
        example='process growth: 1/Y*S -> X rate mu(S)*X "growth"',
        title="processes",
        symbol="Event",
        kind=Kind.PROCESS,
        role="process; its name in an expression is its rate",
    )
    consumed: Expression | None
    produced: Expression | None
    rate: Expression
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `process NAME: consumed -> produced` and its clauses."""
        found = reader.gather(children, "a process")
        name = reader.declared(children[1])
        message = f"the process `{name.text}` has no rate"
        rate = reader.required(children, found, "rate", message, "write `rate …` after what it converts")
        return cls(reader.over(children), name, found.get("consumed"), found.get("produced"), rate, found.get("text"))

    def places(self) -> Iterator[Place]:
        """The rate and the sides."""
        yield Place(self.rate, rules.ANY, self.name.text)
        for side in (self.consumed, self.produced):
            if side is not None:
                yield Place(side, rules.SIDE, process=self.name.text)
