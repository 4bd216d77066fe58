"""`correlate`: deviations of constants from their medians that go together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.nodes import Expression, Name
from gbspec.syntax.statements.base import Entry, Formula, Key, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class CorrelateStatement(Formula):
    """`correlate CL, V`."""

    entry = Entry(
        word="correlate",
        meaning="deviations of these constants between trajectories are correlated, all pairs, learned from 0",
        example="correlate CL, V",
        title=None,
        reserved=False,
    )
    names: tuple[Expression, ...]

    @property
    def constants(self) -> tuple[Name, ...]:
        """The names."""
        return tuple(name for name in self.names if isinstance(name, Name))

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `correlate NAME, NAME`."""
        names = tuple(reader.name_at(token) for token in children[1:] if token.type == "NAME")
        return cls(reader.over(children), names)

    def declares(self) -> tuple[Name, ...]:
        """No names."""
        return ()

    def replaces(self) -> tuple[Key, ...]:
        """A statement about the same constants."""
        return tuple(("correlate", name.text) for name in self.constants)

    def places(self) -> Iterator[Place]:
        """The constants; naming one here does not use it."""
        for name in self.names:
            yield Place(name, rules.CORRELATED, counts=False)
