"""`time`: the independent variable."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Key, Named, Place, fixed
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class TimeStatement(Named):
    """`time t : h [from 0]`."""

    entry = Entry(
        word="time",
        meaning="names the time, its unit, and when every trajectory starts",
        example='time t : h from 0 "since inoculation"',
        title="time",
        kind=Kind.TIME,
        role="the time",
    )
    unit: UnitExpression | None = None
    start: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `time NAME` and its clauses."""
        found = reader.gather(children, "`time`")
        name = reader.declared(children[1])
        return cls(reader.over(children), name, found.get("unit"), found.get("from"), found.get("text"))

    def replaces(self) -> tuple[Key, ...]:
        """One key: a model has one such statement, whatever the time's name."""
        return (("time", ""),)

    def places(self) -> Iterator[Place]:
        """The time at which trajectories start."""
        return fixed(self.start)
