"""`history`: a state before the start, for delays that reach there."""

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
class HistoryStatement(About, Formula):
    """`history X = expr`."""

    entry = Entry(
        word="history",
        meaning="a state before the start, which `delay(X, tau)` sees there; without it the start's value",
        example="history X = X0",
        title="starts",
        about=frozenset({Kind.STATE}),
        reserved=False,
    )
    value: Expression
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `history target` and its clauses."""
        found = reader.gather(children, "a history")
        target: Name | Index = children[1]
        text = target.span.text
        message = f"`history {text}` does not say what `{text}` was"
        value = reader.required(children, found, "value", message, f"write `history {text} = …`")
        return cls(reader.over(children), target, value, found.get("text"))

    def places(self) -> Iterator[Place]:
        """The history."""
        yield Place(self.value, rules.HISTORY)
