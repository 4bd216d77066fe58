"""`input`: a known signal of time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Expression, Interval, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Named, Place, ends, fixed
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class InputStatement(Named):
    """`input F : L/h held`; `interpolation` is None if the user left it out (reported by later checks)."""

    entry = Entry(
        word="input",
        meaning="a known function of time, a column of the data, `held` or `linear` between its rows",
        example='input F : L/h in [0, 1] = 0 held as "feed"',
        title="inputs",
        kind=Kind.INPUT,
        role="input, a known signal of time",
    )
    unit: UnitExpression | None = None
    range: Interval | None = None
    interpolation: Literal["held", "linear"] | None = None
    default: Expression | None = None
    column: Text | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `input NAME` and its clauses."""
        found = reader.gather(children, "an input")
        clauses = (found.get(kind) for kind in ("unit", "range", "interpolation", "value", "column", "text"))
        return cls(reader.over(children), reader.declared(children[1]), *clauses)

    def places(self) -> Iterator[Place]:
        """The default and the range."""
        yield from fixed(self.default)
        yield from ends(self.range)
