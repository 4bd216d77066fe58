"""`initial`: the initial value of a state."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Assignment, Expression, Index, Name, Text
from gbspec.syntax.statements.base import About, Entry, Formula, Key, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class InitialStatement(About, Formula):
    """`initial X = expr`; `initial X learn` and `initial X steady` have no value."""

    entry = Entry(
        word="initial",
        meaning="the initial value of a state: an expression, `learn` to learn it for each trajectory, or `steady`",
        example="initial X = X0",
        title="starts",
        about=frozenset({Kind.STATE}),
    )
    value: Expression | None = None
    description: Text | None = None
    steady: bool = False

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `initial target` and its clauses."""
        found = reader.gather(children, "`initial`")
        target: Name | Index = children[1]
        if sum(kind in found for kind in ("value", "learned", "steady")) != 1:
            reader.problem(
                "GB129",
                f"`initial {target.span.text}` needs one of `= …`, `learn` and `steady`",
                reader.over(children),
                help=f"write `initial {target.span.text} = …` if the initial value is known, else `… learn`",
            )
        return cls(reader.over(children), target, found.get("value"), found.get("text"), "steady" in found)

    def places(self) -> Iterator[Place]:
        """The initial value, unless it is learned."""
        if self.value is not None:
            yield Place(self.value, rules.START)


@dataclass(frozen=True)
class SteadyStatement(Formula):
    """`initial steady with L = 0 then X = 1 when C > 0`: all states start in a steady state."""

    entry = Entry(
        word="steady",
        meaning="all states start in a steady state, reached from their declared starts",
        example="initial steady with L = 0",
        title=None,
        spelled=False,
        reserved=False,
    )
    held: tuple[Assignment, ...] = ()
    after: tuple[Assignment, ...] = ()
    condition: Expression | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `initial steady` and its clauses."""
        found = reader.gather(children, "`initial steady`")
        return cls(
            reader.over(children), found.get("with", ()), found.get("then", ()), found.get("when"), found.get("text")
        )

    def declares(self) -> tuple[Name, ...]:
        """No names."""
        return ()

    def replaces(self) -> tuple[Key, ...]:
        """An earlier `initial steady`."""
        return (("initial", "steady"),)

    def places(self) -> Iterator[Place]:
        """The values that are held, those that states get afterwards, and for which trajectories it counts."""
        for one in self.held:
            yield Place(one.value, rules.HELD)
        for one in self.after:
            yield Place(one.value, rules.RESUMED)
        if self.condition is not None:
            yield Place(self.condition, rules.SOUGHT)
