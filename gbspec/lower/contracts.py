"""Lowers the contracts of unknowns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import assert_never

from gbspec.ir import Expr
from gbspec.ir import model as ir
from gbspec.semantics import outputs_of
from gbspec.syntax import ast


def contract_values(contract: ast.Contract) -> Iterator[ast.Expression]:
    """The expressions of a contract, in the order in which `lower_contracts` expects their values."""
    match contract:
        case ast.Bound(value=value) | ast.ZeroAt(value=value):
            yield value
        case ast.RangeContract(interval=interval):
            yield interval.low
            yield interval.high
        case ast.EqualsAt(value=value, place=place):
            yield value
            yield place
        case ast.Periodic(period=period):
            yield period
        case ast.Shaped():
            return
        case _:
            assert_never(contract)


def lower_contracts(
    statement: ast.UnknownStatement, values: Sequence[Expr], renamed: Mapping[str, str]
) -> dict[str, tuple[ir.Contract, ...]]:
    """The contracts of each output, from the values of all contracts and the arguments' names in the Model."""
    rest = iter(values)
    found: dict[str, list[ir.Contract]] = {name.text: [] for name in statement.names}
    for contract in statement.contracts:
        parts = _parts(contract, [next(rest) for _ in contract_values(contract)], renamed)
        for output in outputs_of(contract, statement):
            found[output].extend(parts)
    return {name: tuple(contracts) for name, contracts in found.items()}


def _parts(contract: ast.Contract, values: Sequence[Expr], renamed: Mapping[str, str]) -> list[ir.Contract]:
    match contract:
        case ast.Bound(operator=operator):
            return [ir.Contract("lower" if operator in (">", ">=") else "upper", values[0], span=contract.span)]
        case ast.RangeContract():
            low, high = values
            return [ir.Contract("lower", low, span=contract.span), ir.Contract("upper", high, span=contract.span)]
        case ast.ZeroAt(argument=argument):
            return [ir.Contract("zero", values[0], renamed[argument.text], contract.span)]
        case ast.EqualsAt(argument=argument):
            value, place = values
            return [ir.Contract("equals", place, renamed[argument.text], contract.span, to=value)]
        case ast.Periodic(argument=argument):
            return [ir.Contract("period", values[0], renamed[argument.text], contract.span)]
        case ast.Shaped(shape=shape, argument=argument):
            return [ir.Contract(shape, None, renamed[argument.text], contract.span)]
        case _:
            assert_never(contract)
