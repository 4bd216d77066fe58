"""`learn`: a constant to be estimated from data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import Bound, Declarator, Distribution, Expression, Grouping, Interval, Text, UnitExpression
from gbspec.syntax.statements.base import Entry, Named, Place, ends, fixed, parameters
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class LearnStatement(Named):
    """`learn beta = 1 in [0, 10] prior normal(3, 0.5) per trajectory ~ lognormal(0.3)`, or a row: `learn k[1..3]`."""

    entry = Entry(
        word="learn",
        meaning="a constant to be learned, with a starting value, bounds, a prior, one value for each trajectory, or a "
        "distribution of these values",
        example='learn beta = 1 in [0, 10] prior normal(3, 0.5) per trajectory "cooling"',
        title="learnable constants",
        symbol="Constant",
        kind=Kind.LEARN,
        role="learnable constant",
        after={"value": "contracts"},  # the starting value, before the bounds
    )
    unit: UnitExpression | None = None
    start: Expression | None = None
    range: Interval | None = None
    bounds: tuple[Bound, ...] = ()
    prior: Distribution | None = None
    per: Grouping | None = None
    description: Text | None = None
    row: tuple[Expression, ...] = ()
    """The first and the last index of a row of constants."""
    further: tuple[Grouping, ...] = ()
    """What stands after the first `per`: groups by other columns."""

    @property
    def groupings(self) -> tuple[Grouping, ...]:
        """All of its groupings."""
        return () if self.per is None else (self.per, *self.further)

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `learn NAME` and its clauses."""
        found = reader.gather(children, "a learnable constant")
        declarator: Declarator = children[1]
        return cls(
            reader.over(children),
            declarator.name,
            found.get("unit"),
            found.get("value"),
            found.get("range"),
            found["bounds"],
            found.get("prior"),
            found.get("per_trajectory"),
            found.get("text"),
            tuple(end for end in (declarator.first, declarator.last) if end is not None),
            found["further"],
        )

    def places(self) -> Iterator[Place]:
        """The starting value, the bounds, the parameters of the prior, and how far values lie apart."""
        yield from fixed(*self.row, self.start, *(bound.value for bound in self.bounds))
        yield from ends(self.range)
        yield from parameters(self.prior)
        for grouping in self.groupings:
            yield from (Place(a, rules.SPREAD) for a in (grouping.spread.arguments if grouping.spread else ()))
