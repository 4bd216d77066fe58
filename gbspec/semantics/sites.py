"""Every expression of a model, with the place it stands in."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from gbspec.diagnostics import Span
from gbspec.semantics import rules
from gbspec.semantics.merge import Item
from gbspec.semantics.rules import Rule
from gbspec.semantics.table import Kind, Table
from gbspec.syntax import ast


@dataclass
class References:
    """What an expression names, its own arguments apart.

    `smooth`: names that stand somewhere outside the condition of an `if`. `complete` is False where something in the
    expression was wrong and has been told; what depends on it is then left alone.
    """

    names: dict[str, Span] = field(default_factory=dict)
    nets: dict[str, Span] = field(default_factory=dict)
    smooth: set[str] = field(default_factory=set)
    complete: bool = True


@dataclass
class Site:
    """One expression: the name that it is the value of (None: a root), its rule, and the arguments that shadow."""

    expression: ast.Expression
    rule: Rule
    owner: str | None = None
    formals: frozenset[str] = frozenset()
    nn: bool = False
    process: str | None = None
    """The process of which it is a side."""
    counts: bool = True
    """Whether naming something here uses it (a truth uses no learnable)."""
    references: References = field(default_factory=References)


def sites(items: Iterable[Item], table: Table) -> Iterator[Site]:
    """All expressions, statement by statement."""
    for item in items:
        if isinstance(item.statement, ast.TruthStatement):
            formals = frozenset(truth_parameters(item.statement, table))
            declaration = table.get(item.statement.name.text)
            number = declaration is not None and declaration.kind is Kind.LEARN
            rule = rules.TRUTH_NUMBER if number else rules.TRUTH
            yield Site(item.statement.value, rule, None, formals, counts=False)
        else:
            yield from _of(item.statement)


def truth_parameters(truth: ast.TruthStatement, table: Table) -> tuple[str, ...]:
    """The parameters of a truth; of an unknown named without parentheses, its arguments as declared."""
    if truth.parameters is not None:
        return tuple(parameter.text for parameter in truth.parameters)
    declaration = table.get(truth.name.text)
    if declaration is None or not isinstance(declaration.statement, ast.UnknownStatement):
        return ()
    return tuple(argument.name.text for argument in declaration.statement.arguments)


def _fixed(*expressions: ast.Expression | None) -> Iterator[Site]:
    for expression in expressions:
        if expression is not None:
            yield Site(expression, rules.CONSTANT)


def _interval(interval: ast.Interval | None) -> Iterator[Site]:
    if interval is not None:
        yield from _fixed(interval.low, interval.high)


def _distribution(distribution: ast.Distribution | None) -> Iterator[Site]:
    if distribution is not None:
        yield from _fixed(*distribution.arguments)


def _of(statement: ast.Statement) -> Iterator[Site]:
    match statement:
        case ast.TimeStatement(start=start):
            yield from _fixed(start)
        case ast.StateStatement(declarator=declarator, range=interval, start=start):
            yield from _fixed(declarator.first, declarator.last, start)
            yield from _interval(interval)
        case (
            ast.ConditionStatement(range=interval, default=default)
            | ast.InputStatement(range=interval, default=default)
        ):
            yield from _fixed(default)
            yield from _interval(interval)
        case ast.ConstStatement(name=name, value=value):
            yield Site(value, rules.CONST_VALUE, name.text)
        case ast.LearnStatement(start=start, range=interval, bounds=bounds, prior=prior):
            yield from _fixed(start, *(bound.value for bound in bounds))
            yield from _interval(interval)
            yield from _distribution(prior)
        case ast.LetStatement(name=name, value=value):
            yield Site(value, rules.ANY, name.text)
        case ast.FunctionStatement(name=name, parameters=parameters, value=value):
            yield Site(value, rules.ANY, name.text, frozenset(p.text for p in parameters))
        case ast.UnknownStatement():
            yield from _unknown(statement)
        case ast.ProcessStatement(name=name, consumed=consumed, produced=produced, rate=rate):
            yield Site(rate, rules.ANY, name.text)
            for side in (consumed, produced):
                if side is not None:
                    yield Site(side, rules.SIDE, process=name.text)
        case _:
            yield from _about(statement)


def _unknown(statement: ast.UnknownStatement) -> Iterator[Site]:
    formals = frozenset(argument.name.text for argument in statement.arguments)
    for postulate in statement.postulates:
        yield Site(postulate, rules.POSTULATE, None, formals, nn=True)
    for argument in statement.arguments:
        yield from _interval(argument.range)
    if statement.network is not None:
        yield from _fixed(*statement.network.widths)
    for contract in statement.contracts:
        match contract:
            case ast.Bound(value=value) | ast.ZeroAt(value=value):
                yield Site(value, rules.POSTULATE, None, formals)
            case ast.RangeContract(interval=interval):
                yield Site(interval.low, rules.POSTULATE, None, formals)
                yield Site(interval.high, rules.POSTULATE, None, formals)
            case ast.Monotone():
                pass


def _about(statement: ast.Statement) -> Iterator[Site]:
    match statement:
        case ast.BalanceStatement(value=value) | ast.ClosureStatement(value=value):
            yield Site(value, rules.ANY)
        case ast.InitialStatement(value=value) if value is not None:
            yield Site(value, rules.START)
        case ast.ObserveStatement(value=value, noise=noise):
            if value is not None:
                yield Site(value, rules.ANY)
            yield from _distribution(noise)
        case ast.DoseStatement(fraction=fraction, lag=lag):
            for part in (fraction, lag):
                if part is not None:
                    yield Site(part, rules.DOSING)
        case ast.ConserveStatement(value=value, rate=rate):
            yield Site(value, rules.CLAIM)
            if rate is not None:
                yield Site(rate, rules.ANY)
        case _:
            return
