"""`model`: the name of the model, its title, and the file that it extends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.nodes import Name, Text
from gbspec.syntax.statements.base import Entry, Key, Mention, Remark
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class ModelStatement(Remark):
    """`model NAME "title" [extends "other.gb"]`."""

    entry = Entry(
        word="model",
        meaning="the model's name, a title, and the file that it extends",
        example='model chemostat "Growth in a chemostat" extends "base.gb"',
        title="model",
        symbol="Module",
    )
    name: Name
    title: Text | None = None
    extends: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `model NAME` and its clauses."""
        found = reader.gather(children, "`model`")
        return cls(reader.over(children), reader.name_at(children[1]), found.get("text"), found.get("extends"))

    def replaces(self) -> tuple[Key, ...]:
        """One key: a model has one such statement."""
        return (("model", ""),)

    def mentions(self) -> Iterator[Mention]:
        """The model's name."""
        yield Mention(self.name, "model", declares=True)
