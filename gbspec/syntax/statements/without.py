"""`without`: removes a statement of the file that the model extends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.nodes import Name
from gbspec.syntax.statements.base import Entry, Key, Mention, Remark
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class WithoutStatement(Remark):
    """`without observe x2` (kind "observe"), `without k` (kind None: the declaration of that name)."""

    entry = Entry(
        word="without",
        meaning="removes a declaration or statement of the extended file",
        example="without observe x2",
        title=None,
    )
    kind: Name | None
    name: Name

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `without KIND NAME`."""
        first, *second = (reader.name_at(token) for token in children[1:])
        if not second:
            return cls(reader.over(children), None, first)
        if first.text not in reader.words:
            reader.problem(
                "GB102",
                f"there is no statement `{first.text}` that `without` could remove",
                first.span,
                help="write `without observe x`, `without initial x`, …, or `without NAME` for what declares a name",
            )
        return cls(reader.over(children), first, second[0])

    def replaces(self) -> tuple[Key, ...]:
        """Nothing: it removes a statement instead."""
        return ()

    def mentions(self) -> Iterator[Mention]:
        """What it removes: a unit, or a name of the model."""
        yield Mention(self.name, "unit" if self.kind is not None and self.kind.text == "unit" else "name")
