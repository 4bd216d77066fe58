"""`effect`: a standard normal number for each trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Grouping, Text
from gbspec.syntax.statements.base import Entry, Formula, Named, Place
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class EffectStatement(Named, Formula):
    """`effect e per trajectory`."""

    entry = Entry(
        word="effect",
        meaning="a standard normal number for each trajectory, an argument of an unknown function that differs between "
        "them",
        example='effect e per trajectory "speed of absorption"',
        title="random effects",
        symbol="Constant",
        kind=Kind.LEARN,
        role="random effect",
        reserved=False,
    )
    per: Grouping
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `effect NAME` and its clauses."""
        found = reader.gather(children, "an effect")
        name = reader.declared(children[1])
        message = f"`effect {name.text}` does not say between what it differs"
        per = reader.required(children, found, "per_trajectory", message, f"write `effect {name.text} per trajectory`")
        if not isinstance(per, Grouping):  # reported
            per = Grouping(name.span, Text(name.span, "trajectory"))
        for second in found["further"]:
            reader.problem("GB126", "an effect has one grouping, and here is a second", second.span,
                           help="declare another effect")  # fmt: skip
        return cls(reader.over(children), name, per, found.get("text"))

    def places(self) -> Iterator[Place]:
        """No expressions."""
        return iter(())
