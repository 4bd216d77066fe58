"""`conserve`: a claim about the rate of a quantity."""

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
class ConserveStatement(Named, Formula):
    """`conserve total = X + S/Yxs rate r`."""

    entry = Entry(
        word="conserve",
        meaning="a claim that the rate of this quantity is zero (or as given), proved or refuted at compile time",
        example='conserve total = X + S/Yxs rate r "mass"',
        title="claims",
        kind=Kind.CLAIM,
        role="claim that a quantity is conserved",
        after={"rate": "value"},
    )
    value: Expression
    rate: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `conserve NAME` and its clauses."""
        found = reader.gather(children, "`conserve`")
        name = reader.declared(children[1])
        message = f"`conserve {name.text}` does not say what is conserved"
        value = reader.required(children, found, "value", message, f"write `conserve {name.text} = …`")
        return cls(reader.over(children), name, value, found.get("rate"), found.get("text"))

    def places(self) -> Iterator[Place]:
        """The quantity and its rate."""
        yield Place(self.value, rules.CLAIM)
        if self.rate is not None:
            yield Place(self.rate, rules.ANY)
