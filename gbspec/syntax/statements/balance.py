"""A balance: how a state changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.diagnostics import Span
from gbspec.syntax import rules
from gbspec.syntax.nodes import Expression, Text
from gbspec.syntax.statements.base import About, Entry, Formula, Place, target_text
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class BalanceStatement(About, Formula):
    """`X' = net(X) - D*X`, or `c[i]' = …` for every i."""

    entry = Entry(
        word="balance",
        meaning="the rate of change of a state",
        example="X' = net(X) - D*X",
        title="balances",
        symbol="Operator",
        spelled=False,
    )
    value: Expression
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `target'` and its clauses."""
        found = reader.gather(children, "a balance")
        return cls(reader.over(children), children[0], found["value"], found.get("text"))

    def places(self) -> Iterator[Place]:
        """The right side."""
        yield Place(self.value, rules.ANY)

    def outlined(self) -> tuple[tuple[str, Span], ...]:
        """The target as it is written."""
        return ((f"{target_text(self.target)}'", self.target.span),)
