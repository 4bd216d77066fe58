"""`unknown`: functions to be learned."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self, assert_never

from gbspec.syntax import rules
from gbspec.syntax.kinds import Kind
from gbspec.syntax.nodes import (
    Argument,
    Bound,
    Contract,
    EqualsAt,
    Expression,
    Name,
    NetworkSpec,
    Periodic,
    RangeContract,
    Shaped,
    Text,
    UnitExpression,
    ZeroAt,
)
from gbspec.syntax.statements.base import Declaration, Entry, Place, ends, fixed
from gbspec.syntax.transformer import Children, ClauseRules


@dataclass(frozen=True)
class UnknownStatement(Declaration):
    """`unknown a, b(x, y) : u contracts = postulate by mlp(32)`."""

    entry = Entry(
        word="unknown",
        meaning="a function to be learned, with contracts, a postulate, and the network that represents it",
        example='unknown mu(u, g in [0, 5]) : 1/h >= 0, zero at u = 0 = u*nn by mlp(32, 32) "growth"',
        title="unknown functions",
        symbol="Function",
        kind=Kind.UNKNOWN,
        role="unknown function, to be learned",
    )
    names: tuple[Name, ...]
    arguments: tuple[Argument, ...]
    units: tuple[UnitExpression, ...] = ()
    contracts: tuple[Contract, ...] = ()
    postulates: tuple[Expression, ...] = ()
    network: NetworkSpec | None = None
    description: Text | None = None

    @classmethod
    def read(cls, reader: ClauseRules, children: Children) -> Self:
        """Builds the node from `unknown names(arguments)` and its clauses."""
        found = reader.gather(children, "an unknown function")
        return cls(
            reader.over(children),
            children[1].items,
            next((child for child in children if isinstance(child, tuple)), ()),
            found.get("unit", ()),
            found["contracts"],
            found.get("postulates", ()),
            found.get("network"),
            found.get("text"),
        )

    def declares(self) -> tuple[Name, ...]:
        """The names of the outputs."""
        return self.names

    def places(self) -> Iterator[Place]:
        """The postulates, the ranges of the arguments, the widths of the network, and the expressions of contracts."""
        formals = frozenset(argument.name.text for argument in self.arguments)
        for postulate in self.postulates:
            yield Place(postulate, rules.POSTULATE, None, formals, nn=True)
        for argument in self.arguments:
            yield from ends(argument.range)
        if self.network is not None:
            yield from fixed(*self.network.widths)
        for contract in self.contracts:
            for value in _values(contract):
                yield Place(value, rules.POSTULATE, None, formals)


def _values(contract: Contract) -> tuple[Expression, ...]:
    match contract:
        case Bound(value=value) | ZeroAt(value=value):
            return (value,)
        case RangeContract(interval=interval):
            return interval.low, interval.high
        case EqualsAt(value=value, place=place):
            return value, place
        case Periodic(period=period):
            return (period,)
        case Shaped():
            return ()
        case _:
            assert_never(contract)
