"""`dose`: amounts that the data add to a state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Text
from gbspec.syntax.statements.base import About, Entry, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class DoseStatement(About):
    """`dose S over D times F lag tlag`."""

    entry = Entry(
        word="dose",
        meaning="amounts from the data are added to this state at given times (column `dose_NAME`)",
        example='dose S over D times F lag tlag "oral"',
        title="doses",
        symbol="Event",
        about=frozenset({Kind.STATE}),
    )
    duration: Expression | None = None
    fraction: Expression | None = None
    lag: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `dose target` and its clauses."""
        found = reader.gather(children, "a dose")
        return cls(
            reader.over(children),
            children[1],
            found.get("over"),
            found.get("times"),
            found.get("lag"),
            found.get("text"),
        )

    def places(self) -> Iterator[Place]:
        """The duration of infusions, the fraction that arrives, and the lag."""
        if self.duration is not None:
            yield Place(self.duration, rules.DURATION)
        for part in (self.fraction, self.lag):
            if part is not None:
                yield Place(part, rules.DOSING)
