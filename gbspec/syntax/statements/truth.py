"""`truth`: the reference for a learnable constant or an unknown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Index, Name
from gbspec.syntax.statements.base import About, Entry, Formula, Key, Place, fixed
from gbspec.syntax.transformer import Children, ClauseRules, Names


@dataclass(frozen=True)
class TruthStatement(About, Formula):
    """`truth beta = 3`, `truth phi(x1, x2, Da) = …` (`parameters` is None without parentheses)."""

    entry = Entry(
        word="truth",
        meaning="the reference for a learnable or an unknown: simulation and validation use it, training does not",
        example="truth mu(u, g) = u/(1 + u)",
        title="truths",
        about=frozenset({Kind.LEARN, Kind.UNKNOWN}),
    )
    target: Name
    value: Expression
    parameters: tuple[Name, ...] | None = None
    index: Expression | None = None
    """Of an element of a row of constants."""

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `truth NAME(names) = value`."""
        found = reader.gather(children, "a truth")
        formals = next((child.items for child in children if isinstance(child, Names)), None)
        target = children[1]
        name, index = (target.array, target.index) if isinstance(target, Index) else (target, None)
        return cls(reader.over(children), name, found["value"], formals, index)

    def replaces(self) -> tuple[Key, ...]:
        """The target, with its index."""
        index = f"[{''.join(self.index.span.text.split())}]" if self.index is not None else ""
        return ((self.entry.word, f"{self.target.text}{index}"),)

    def places(self) -> Iterator[Place]:
        """The value; its rule is judged from this statement only (parameters: the truth of an unknown)."""
        yield from fixed(self.index)
        formals = frozenset(parameter.text for parameter in self.formals())
        yield Place(self.value, rules.TRUTH, None, formals, counts=False)

    def formals(self) -> tuple[Name, ...]:
        """The parameters, if they are written."""
        return self.parameters or ()
