"""Warnings of values that do not exist somewhere: roots and logarithms of negative numbers, divisions by zero at the
start, negative coefficients of processes.

A logarithm, root or power is tried at points of the declared ranges, and the warning names one where it has no value:
it is never due to a bound that is too wide. Branches of an `if` are left out, since their condition may guard them.
"""

from __future__ import annotations

import math
import random
from collections import ChainMap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from gbspec.diagnostics import Findings
from gbspec.semantics.constants import Evaluator
from gbspec.semantics.expressions import operands, walk
from gbspec.semantics.merge import Item
from gbspec.semantics.numbers import Numbers, default_start, functions_of
from gbspec.semantics.processes import Term
from gbspec.semantics.sites import Sites
from gbspec.semantics.table import Table
from gbspec.syntax import Kind, ast, ungrouped

POINTS = 64
MOST = 50
"""The most warnings about logarithms, roots and powers."""
WORK = 20_000
"""The most expressions that are evaluated for all points together; large models are tried at fewer points."""
USUAL = (1e-3, 0.5, 1.0, 10.0)
"""Values at which powers are tried for a quantity without a range: most quantities are positive."""


@dataclass(frozen=True)
class Subject:
    """What the checks know of a model: values of constants, ranges by name, named expressions in their order."""

    items: tuple[Item, ...]
    table: Table
    values: dict[str, float]
    order: tuple[str, ...]
    numbers: Numbers
    sites: Sites

    @cached_property
    def functions(self) -> dict[str, ast.FunctionStatement]:
        """The declared functions."""
        return functions_of(self.table)

    @cached_property
    def named(self) -> dict[str, ast.Expression]:
        """The values of `let`, by name, and the rates of processes."""
        found: dict[str, ast.Expression] = {}
        for item in self.items:
            if isinstance(item.statement, ast.LetStatement):
                found[item.statement.name.text] = item.statement.value
            elif isinstance(item.statement, ast.ProcessStatement):
                found[item.statement.name.text] = item.statement.rate
        return found

    @cached_property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """The declared ranges of states, conditions, inputs and learnables, where they are finite at an end."""
        found: dict[str, tuple[float, float] | None] = {}
        for item in self.items:
            match item.statement:
                case (
                    ast.StateStatement(declarator=declarator, range=interval)
                    | ast.AlgebraicStatement(declarator=declarator, range=interval)
                ):
                    found[declarator.name.text] = self.numbers.interval(interval)
                case ast.ConditionStatement(name=name, range=interval) | ast.InputStatement(name=name, range=interval):
                    found[name.text] = self.numbers.interval(interval)
                case ast.LearnStatement(name=name) as statement:
                    found[name.text] = self.numbers.bounds(statement)
                case _:
                    pass
        return {name: ends for name, ends in found.items() if ends is not None and any(map(math.isfinite, ends))}


@dataclass(frozen=True)
class Use:
    """A function or power that has no value where `argument` is negative, and the name that `allow` takes."""

    node: ast.Expression
    argument: ast.Expression
    subject: str
    function: str
    """`log`, …; empty for a power."""


def check(subject: Subject, findings: Findings) -> None:
    """Warns of what may have no value: GB316 (logarithms, roots), GB317 (at the start), GB318 (powers)."""
    uses = list(_uses(subject))
    if uses:
        _negative(subject, uses, findings)
    _start(subject, findings)


def coefficients(terms: Mapping[str, tuple[tuple[bool, Term], ...]], subject: Subject, findings: Findings) -> None:
    """Warns of terms of processes whose coefficient is negative, or may become so (GB319)."""
    ranges = subject.ranges
    for process, sides in terms.items():
        for consumed, term in sides:
            lowest = _lowest(term, subject, ranges)
            if lowest is None or lowest >= 0.0:
                continue
            word = "consumed" if consumed else "produced"
            other = "produces" if consumed else "consumes"
            fixed = all(part.text not in ranges for _, factor in term.factors for part in _names(factor))
            can = "is" if fixed else "can become"
            findings.warning(
                "GB319",
                f"the coefficient of `{term.state}`, {word} by `{process}`, {can} {lowest:.4g}",
                term.span,
                label=f"{'so' if fixed else 'then'} the process {other} it",
                help=f"write the state on the other side of `->`, or accept it with `allow GB319 {term.state}`"
                if fixed
                else f"bound it by zero (`in [0, …]`), or accept it with `allow GB319 {term.state}`",
                subject=term.state,
            )


def _lowest(term: Term, subject: Subject, ranges: Mapping[str, tuple[float, float]]) -> float | None:
    """The lowest value of a coefficient over the finite ends of its learnables; None if it is not known."""
    lowest: float | None = None
    for point in _corners([part.text for _, factor in term.factors for part in _names(factor)], subject, ranges):
        evaluate = Evaluator(point, subject.functions)
        value = -1.0 if term.negative else 1.0
        for below, factor in term.factors:
            part = evaluate(factor)
            if part is None or (below and part == 0.0):
                break
            value = value / part if below else value * part
        else:
            lowest = value if lowest is None else min(lowest, value)
    return lowest


def _corners(
    names: list[str], subject: Subject, ranges: Mapping[str, tuple[float, float]]
) -> Iterator[Mapping[str, float]]:
    """The values of constants, with the named learnables at all finite ends of their ranges (at most eight names)."""
    points: list[dict[str, float]] = [{}]
    for name in [name for name in dict.fromkeys(names) if name in ranges][:8]:
        ends = [end for end in ranges[name] if math.isfinite(end)]
        points = [{**point, name: end} for point in points for end in ends]
    yield from (ChainMap(point, subject.values) for point in points)


def _names(node: ast.Expression) -> Iterator[ast.Name]:
    return (part for part in walk(node) if isinstance(part, ast.Name))


# ------------------------------------------------------------------------------------------------- negative arguments
def _roots(items: Iterable[Item]) -> Iterator[tuple[str, ast.Expression]]:
    """Every expression that is evaluated along a trajectory, with the name of what it determines."""
    for item in items:
        match item.statement:
            case ast.LetStatement(name=name, value=value) | ast.ProcessStatement(name=name, rate=value):
                yield name.text, value
            case ast.BalanceStatement(target=ast.Name(text=text), value=value):
                yield text, value
            case ast.EquationStatement(target=ast.Name(text=text), left=left, right=right):
                yield text, left
                yield text, right
            case ast.ObserveStatement(target=ast.Name(text=text), value=value) if value is not None:
                yield text, value
            case _:
                pass


def _uses(subject: Subject) -> Iterator[Use]:
    """The logarithms, square roots and powers with an exponent that need not be whole; not those within an `if`."""
    for owner, root in _roots(subject.items):
        pending = [root]
        while pending:
            node = pending.pop()
            match node:
                case ast.Conditional(condition=condition):
                    pending.append(condition)
                    continue
                case ast.Call(function=ast.Name(text="log" | "log10" | "sqrt" as name), arguments=(argument,)):
                    yield Use(node, argument, owner, name)
                case ast.Binary(operator="^", left=left, right=right) if not _whole(right, subject):
                    yield Use(node, left, owner, "")
                case _:
                    pass
            pending.extend(operands(node))


def _whole(exponent: ast.Expression, subject: Subject) -> bool:
    """Whether an exponent is a whole number: a constant one, or what `floor` and `ceil` give."""
    inner = ungrouped(exponent)
    if isinstance(inner, ast.Call) and inner.function.text in ("floor", "ceil"):
        return True
    value = Evaluator(subject.values, subject.functions)(exponent)
    return value is not None and value == round(value)


def _negative(subject: Subject, uses: list[Use], findings: Findings) -> None:
    """Warns of each use whose argument is negative at a point of the ranges."""
    named = subject.named
    order = _needed(uses, named, subject.order)
    leaves = sorted({n.text for use in uses for n in _names(use.argument)} | _leaves(order, named))
    waiting, told = list(uses), set[int]()
    for point in _points(leaves, subject, max(4, min(POINTS, WORK // (len(order) + len(uses))))):
        ranged = dict(subject.values) | {n: v for n, v in point.items() if n in subject.ranges}
        known, guessed = _filled(ranged, order, named, subject), _filled({**ranged, **point}, order, named, subject)
        left = []
        for use in waiting:
            values = known if use.function else guessed
            value = Evaluator(values, subject.functions)(use.argument)
            if value is None or value >= -1e-12:
                left.append(use)
            elif use.node.span.start not in told and len(told) < MOST:  # the elements of an array have one place
                told.add(use.node.span.start)
                _report(use, value, values, subject, findings)
        waiting = left


def _needed(uses: list[Use], named: Mapping[str, ast.Expression], order: tuple[str, ...]) -> list[str]:
    """The named expressions on which the arguments depend, each after those that it depends on."""
    found: set[str] = set()
    pending = [n.text for use in uses for n in _names(use.argument)]
    while pending:
        name = pending.pop()
        if name in named and name not in found:
            found.add(name)
            pending.extend(n.text for n in _names(named[name]))
    return [name for name in order if name in found]


def _leaves(order: list[str], named: Mapping[str, ast.Expression]) -> set[str]:
    return {n.text for name in order for n in _names(named[name])}


def _points(leaves: list[str], subject: Subject, count: int) -> Iterator[dict[str, float]]:
    """Values of states, conditions, inputs and learnables: ends, middles, and points between them, always the same."""
    ranges = subject.ranges
    kinds = (Kind.STATE, Kind.ALGEBRAIC, Kind.CONDITION, Kind.INPUT, Kind.LEARN)
    names = [n for n in leaves if n in subject.table and subject.table[n].kind in kinds]
    draw = random.Random(0)
    for number in range(count):
        point = {}
        for name in names:
            if name not in ranges:
                point[name] = draw.choice(USUAL)
                continue
            low, high = ranges[name]
            low, high = (low if math.isfinite(low) else high - 10.0), (high if math.isfinite(high) else low + 10.0)
            share = (0.0, 1.0)[number] if number < 2 else draw.choice((0.0, 1.0, 0.5, draw.random()))
            point[name] = low + share * (high - low)
        yield point


def _filled(
    point: Mapping[str, float], order: list[str], named: Mapping[str, ast.Expression], subject: Subject
) -> dict[str, float]:
    """A point with the values of the named expressions there, as far as they have one."""
    values = dict(point)
    evaluate = Evaluator(values, subject.functions)
    for name in order:
        value = evaluate(named[name])
        if value is not None:
            values[name] = value
    return values


def _report(use: Use, value: float, values: Mapping[str, float], subject: Subject, findings: Findings) -> None:
    ranges = subject.ranges
    through = _leaves(_needed([use], subject.named, subject.order), subject.named)
    names = [n for n in dict.fromkeys([n.text for n in _names(use.argument)] + sorted(through)) if n in values]
    names = [n for n in names if n not in subject.values and n not in subject.named]
    place = ", ".join(f"{n} = {values[n]:.4g}" for n in names[:4])
    unranged = [n for n in names if n not in ranges]
    text = ungrouped(use.argument).span.text
    where = f"`{text}`" if len(text) <= 40 else "its argument"
    findings.warning(
        "GB316" if use.function else "GB318",
        f"`{_short(use.node)}` has no value where {where} is negative" + (f", as at {place}" if place else ""),
        use.node.span,
        label=f"{where} is {value:.4g} there",
        notes=["; ".join(f"`{n}` declares no range" for n in unranged)] if unranged else [],
        help=f"narrow the ranges, guard it by `max(…, 0)` or `if`, or accept it with "
        f"`allow {'GB316' if use.function else 'GB318'} {use.subject}`",
        subject=use.subject,
    )


# ------------------------------------------------------------------------------------------------------- the start
def _start(subject: Subject, findings: Findings) -> None:
    """Warns of divisions by zero at the starting values of the states, learnables, conditions and inputs."""
    told: set[int] = set()
    values = _starting(subject)
    owner = ""

    def not_finite(node: ast.Expression, value: float, by_zero: bool) -> None:
        if not by_zero or node.span.start in told:
            return
        told.add(node.span.start)
        zero = math.isnan(value)
        findings.warning(
            "GB317",
            f"`{_short(node)}` is {'0/0' if zero else 'a division by zero'} at the start",
            node.span,
            label="not a number with the starting values" if zero else "infinite with the starting values",
            help=f"choose another start, add a small number to the divisor, or accept it with `allow GB317 {owner}`",
            subject=owner,
        )

    evaluate = Evaluator(values, subject.functions, not_finite)
    named = subject.named
    for owner in subject.order:
        if owner in named and (value := evaluate(named[owner])) is not None:
            values[owner] = value
    for owner, root in _roots(subject.items):
        if owner not in named:
            evaluate(root)


def _starting(subject: Subject) -> dict[str, float]:
    """The values at the start, of all names for which the model states one."""
    values = dict(subject.values)
    for item in subject.items:
        match item.statement:
            case (
                ast.StateStatement(declarator=declarator, start=start)
                | ast.AlgebraicStatement(declarator=declarator, start=start)
            ):
                _put(values, declarator.name.text, subject.numbers.value(start))
            case ast.ConditionStatement(name=name, default=start) | ast.InputStatement(name=name, default=start):
                _put(values, name.text, subject.numbers.value(start))
            case ast.LearnStatement(name=name, start=start) as statement:
                ends = subject.numbers.bounds(statement)
                middle = default_start(*ends) if ends is not None and any(map(math.isfinite, ends)) else None
                value = subject.numbers.value(start)
                _put(values, name.text, middle if value is None else value)
            case ast.TimeStatement(name=name, start=start):
                _put(values, name.text, subject.numbers.value(start))
            case _:
                pass
    evaluate = Evaluator(dict(values), subject.functions)
    for item in subject.items:
        if isinstance(item.statement, ast.InitialStatement) and isinstance(item.statement.target, ast.Name):
            values.pop(item.statement.target.text, None)
            value = None if item.statement.value is None else evaluate(item.statement.value)
            _put(values, item.statement.target.text, value)
    return values


def _put(values: dict[str, float], name: str, value: float | None) -> None:
    if value is not None:
        values[name] = value


def _short(node: ast.Expression) -> str:
    text = node.span.text
    return text if len(text) <= 60 else text[:57] + "…"
