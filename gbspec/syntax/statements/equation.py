"""`equation`: an equation with a name, which determines algebraic variables."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Name, Text
from gbspec.syntax.statements.base import About, Entry, Formula, Place, target_name
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class EquationStatement(About, Formula):
    """`equation charge: 0 = Na + H - OH - A`, or `equation level[i]: h[i] = q[i]/k` for every i."""

    entry = Entry(
        word="equation",
        meaning="an equation that holds at all times and determines an algebraic variable",
        example="equation charge: 0 = Na + 10^(-pH) - Kw*10^pH - A",
        title="equations",
        symbol="Operator",
        kind=Kind.EQUATION,
        role="equation",
        reserved=False,
    )
    left: Expression
    right: Expression
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `equation NAME: left = right` and its description."""
        found = reader.gather(children, "an equation")
        return cls(reader.over(children), children[1], found["left"], found["value"], found.get("text"))

    def declares(self) -> tuple[Name, ...]:
        """The name of the equation; those of elements share one."""
        return (target_name(self.target),)

    def places(self) -> Iterator[Place]:
        """Both sides."""
        yield Place(self.left, rules.ANY)
        yield Place(self.right, rules.ANY)
