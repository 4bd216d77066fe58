"""`initial`: the initial value of a state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Index, Name, Text
from gbspec.syntax.statements.base import About, Entry, Formula, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class InitialStatement(About, Formula):
    """`initial X = expr`; `initial X learn` has no value."""

    entry = Entry(
        word="initial",
        meaning="the initial value of a state: an expression, or `learn` to learn it for each trajectory",
        example="initial X = X0",
        title="starts",
        about=frozenset({Kind.STATE}),
    )
    value: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `initial target` and its clauses."""
        found = reader.gather(children, "`initial`")
        target: Name | Index = children[1]
        if ("value" in found) == ("learned" in found):
            reader.problem(
                "GB129",
                f"`initial {target.span.text}` needs either `= …` or `learn`",
                reader.over(children),
                help=f"write `initial {target.span.text} = …` if the initial value is known, else `… learn`",
            )
        return cls(reader.over(children), target, found.get("value"), found.get("text"))

    def places(self) -> Iterator[Place]:
        """The initial value, unless it is learned."""
        if self.value is not None:
            yield Place(self.value, rules.START)
