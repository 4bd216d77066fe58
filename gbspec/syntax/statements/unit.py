"""`unit`: a base unit defined by the model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.nodes import Name, Text
from gbspec.syntax.statements.base import Entry, Key, Mention, Remark
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class UnitStatement(Remark):
    """`unit gX "gram of biomass"`."""

    entry = Entry(
        word="unit",
        meaning="a new base unit, so that masses of different substances cannot be added by mistake",
        example='unit gX "gram of biomass"',
        title="units",
        symbol="EnumMember",
    )
    name: Name
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `unit NAME` and its description."""
        found = reader.gather(children, "`unit`")
        return cls(reader.over(children), reader.name_at(children[1]), found.get("text"))

    def replaces(self) -> tuple[Key, ...]:
        """One key; units have a namespace separate from that of expressions."""
        return (("unit", self.name.text),)

    def mentions(self) -> Iterator[Mention]:
        """The unit."""
        yield Mention(self.name, "unit", declares=True)
