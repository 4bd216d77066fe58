"""`allow`: a warning that the author of the model accepts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.nodes import Name
from gbspec.syntax.statements.base import Entry, Key, Mention, Remark
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class AllowStatement(Remark):
    """`allow GB401 NAME`."""

    entry = Entry(word="allow", meaning="accepts a named warning", example="allow GB401 k", title=None)
    code: Name
    name: Name | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `allow CODE NAME`."""
        code, *name = (reader.name_at(token) for token in children[1:])
        return cls(reader.over(children), code, name[0] if name else None)

    def replaces(self) -> tuple[Key, ...]:
        """Nothing: the remarks of both files are kept."""
        return ()

    def mentions(self) -> Iterator[Mention]:
        """The code, and the name that the warning is about."""
        yield Mention(self.code, "code")
        if self.name is not None:
            yield Mention(self.name, "name")
