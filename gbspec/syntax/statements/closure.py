"""The value used for an element beyond an end of an array."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.diagnostics import Span
from gbspec.syntax import rules
from gbspec.syntax.nodes import Expression, Index, Name
from gbspec.syntax.statements.base import Entry, Formula, Key, Place, target_text
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class ClosureStatement(Formula):
    """`c[0] = cin`: an end of an array of states."""

    entry = Entry(
        word="closure",
        meaning="the value used for an element beyond the end of an array",
        example="c[0] = cin",
        title="ends of arrays",
        spelled=False,
    )
    target: Index
    value: Expression

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `array[index] = value`."""
        found = reader.gather(children, "the end of an array")
        return cls(reader.over(children), children[0], found["value"])

    def declares(self) -> tuple[Name, ...]:
        """No names."""
        return ()

    def replaces(self) -> tuple[Key, ...]:
        """The element that it defines."""
        return (("closure", target_text(self.target)),)

    def places(self) -> Iterator[Place]:
        """The right side."""
        yield Place(self.value, rules.ANY)

    def outlined(self) -> tuple[tuple[str, Span], ...]:
        """The element that it defines."""
        return ((target_text(self.target), self.target.span),)
