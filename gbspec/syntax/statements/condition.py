"""`condition`: a known quantity that is constant within a trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Categories, Expression, Interval, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Named, Place, ends, fixed
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class ConditionStatement(Named):
    """`condition Da in [0.2, 0.5] = 0.3 as "column"`, or `condition strain in {"wild type", mutant}`."""

    entry = Entry(
        word="condition",
        meaning="known and constant within a trajectory, a column of the data",
        example='condition Da in [0.2, 0.5] = 0.3 as "Damkoehler" "number"',
        title="conditions",
        symbol="Constant",
        kind=Kind.CONDITION,
        role="condition, known and constant within a trajectory",
    )
    unit: UnitExpression | None = None
    range: Interval | None = None
    default: Expression | None = None
    column: Text | None = None
    description: Text | None = None
    categories: Categories | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `condition NAME` and its clauses."""
        found = reader.gather(children, "a condition")
        clauses = (found.get(kind) for kind in ("unit", "range", "value", "column", "text", "categories"))
        return cls(reader.over(children), reader.declared(children[1]), *clauses)

    def places(self) -> Iterator[Place]:
        """The default and the range."""
        yield from fixed(self.default)
        yield from ends(self.range)
