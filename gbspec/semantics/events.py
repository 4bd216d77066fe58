"""Events and discrete values: what an event may set, and what is not offered for a value that only events change."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable
from dataclasses import replace

from gbspec.diagnostics import Findings, Label
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.numbers import Numbers
from gbspec.semantics.table import Table
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import Kind, ast, target_name

MOST_WAITING = 64
"""The largest `queue`: each place in it is two states more."""


def expand(merged: Merged, findings: Findings) -> Merged:
    """The statements with each `discrete` written as a state with a known start and the balance zero.

    All that follows sees ordinary states; `check` has looked at what would be confusing about them.
    """
    if not any(isinstance(item.statement, ast.DiscreteStatement | ast.EventStatement) for item in merged.items):
        return merged
    _refuse(merged.items, findings)
    _unset(merged, findings)
    names = {item.statement.name.text for item in merged.items if isinstance(item.statement, ast.DiscreteStatement)}
    items = tuple(made for item in merged.items if not _balances(item, names) for made in _written(item))
    return replace(merged, items=items)


def _balances(item: Item, names: Container[str]) -> bool:
    """Whether it is the balance of one of these names, which was reported."""
    return isinstance(item.statement, ast.BalanceStatement) and target_name(item.statement.target).text in names


def _written(item: Item) -> list[Item]:
    statement = item.statement
    if not isinstance(statement, ast.DiscreteStatement):
        return [item]
    span, name = statement.name.span, statement.name
    made: list[ast.Statement] = [
        ast.StateStatement(
            statement.span,
            ast.Declarator(span, name),
            statement.unit,
            statement.range,
            None,
            statement.description,
        ),
        ast.BalanceStatement(span, name, ast.Number(span, "0")),
        ast.InitialStatement(span, name, statement.value),
    ]
    return [Item(one, item.text if i == 0 else "") for i, one in enumerate(made)]


def _refuse(items: Iterable[Item], findings: Findings) -> None:
    """Errors for statements that would change a discrete value in time, and for what events do not offer yet."""
    items = tuple(items)
    discretes = {i.statement.name.text: i.statement for i in items if isinstance(i.statement, ast.DiscreteStatement)}
    arrays = {
        i.statement.declarator.name.text
        for i in items
        if isinstance(i.statement, ast.StateStatement) and i.statement.declarator.first is not None
    }
    for statement in (item.statement for item in items):
        match statement:
            case ast.BalanceStatement(target=target):
                _holds(target_name(target), "has no balance", discretes, findings)
            case ast.DoseStatement(target=target):
                _holds(target_name(target), "takes no doses", discretes, findings)
            case ast.DiffusionStatement(target=target):
                _holds(target_name(target), "has no diffusion", discretes, findings)
                _with_diffusion(statement, items, findings)
            case ast.EventStatement():
                _not_yet(statement, arrays, findings)
            case _:
                pass


def _holds(name: ast.Name, lacks: str, discretes: dict[str, ast.DiscreteStatement], findings: Findings) -> None:
    if name.text in discretes:
        findings.error(
            "GB346",
            f"`{name.text}` is a discrete value, which {lacks}: only events change it",
            name.span,
            labels=[Label(discretes[name.text].name.span, "declared here")],
            help=f"declare `state {name.text}` if it changes between events, or set it in an event",
        )


def _with_diffusion(statement: ast.DiffusionStatement, items: tuple[Item, ...], findings: Findings) -> None:
    first = next((i.statement for i in items if isinstance(i.statement, ast.EventStatement)), None)
    if first is not None:
        findings.error(
            "GB351",
            "events and random disturbances are not offered in one model yet",
            statement.span,
            labels=[Label(first.name.span, "an event")],
            help="leave out the diffusion, or the events",
        )


def _not_yet(statement: ast.EventStatement, arrays: Iterable[str], findings: Findings) -> None:
    """What events do not offer in this version."""
    for assignment in statement.assignments:
        target = target_name(assignment.target)
        if isinstance(assignment.target, ast.Index) or target.text in arrays:
            findings.error(
                "GB351",
                f"an event cannot set elements of an array yet, and `{target.text}` is one",
                assignment.target.span,
                help="declare the states that events set one by one",
            )


def check(items: Iterable[Item], table: Table, numbers: Numbers, findings: Findings, merged: Merged) -> None:
    """Checks that events set states, each once (GB347, GB348), and how they wait (GB384)."""
    for event in (item.statement for item in items):
        if not isinstance(event, ast.EventStatement):
            continue
        _waits(event, numbers, findings)
        first: dict[str, ast.Name] = {}
        for assignment in event.assignments:
            name = target_name(assignment.target)
            earlier = first.setdefault(name.text, name)
            if earlier is not name:
                findings.error(
                    "GB348",
                    f"the event `{event.name.text}` sets `{name.text}` twice",
                    name.span,
                    label="again",
                    labels=[Label(earlier.span, "the first")],
                    help="write one right side; each sees the values before the event",
                )
            _settable(name, table, findings, merged)


def _waits(s: ast.EventStatement, numbers: Numbers, findings: Findings) -> None:
    """Reports delays and queues that say nothing (GB384)."""
    delay, queue = numbers.value(s.after), numbers.value(s.queue)
    name = s.name.text
    if s.after is not None and delay is not None and delay < 0:
        findings.error(
            "GB384",
            f"`{name}` acts {-delay:g} before its condition becomes true",
            s.after.span,
            help="a delay is positive or zero",
        )
    if s.queue is None:
        return
    if s.after is None:
        findings.error(
            "GB384", f"`{name}` does not wait, so that `queue` says nothing", s.queue.span, help="add `after …`"
        )
    elif s.transient:
        findings.error(
            "GB384",
            f"`{name}` is `transient`, so that only one of it can wait: its condition ends before it begins again",
            s.queue.span,
            help="leave out `queue`, or `transient`",
        )
    if queue is not None and not (math.isfinite(queue) and queue == int(queue) and 1 <= queue <= MOST_WAITING):
        findings.error(
            "GB384",
            f"{queue:g} is not a number of places in which `{name}` can wait",
            s.queue.span,
            help=f"write a whole number from 1 to {MOST_WAITING}",
        )


def _settable(name: ast.Name, table: Table, findings: Findings, merged: Merged) -> None:
    declaration = table.get(name.text)
    if declaration is None:
        if merged.lacks(name.text) and name.text not in merged.arrays:
            states = [n for n, d in table.items() if d.kind is Kind.STATE]
            findings.error(
                "GB201",
                f"no state is named `{name.text}`",
                name.span,
                label="not declared",
                help=suggestion(name.text, states) or f"declare it: `discrete {name.text} = 0`",
                subject=name.text,
            )
    elif declaration.kind is not Kind.STATE:
        findings.error(
            "GB347",
            f"`{name.text}` is {declaration.kind.value}, and an event sets states and discrete values",
            name.span,
            labels=[Label(declaration.span, "declared here")] if declaration.span is not None else [],
            help=f"declare `discrete {name.text} = …` instead, and use it in its place",
        )


def _unset(merged: Merged, findings: Findings) -> None:
    """Warns of discrete values that no event sets (GB353)."""
    set_ = {
        target_name(assignment.target).text
        for item in merged.items
        if isinstance(item.statement, ast.EventStatement)
        for assignment in item.statement.assignments
    }
    for item in merged.items:
        statement = item.statement
        if isinstance(statement, ast.DiscreteStatement) and statement.name.text not in set_ | merged.uncertain:
            name = statement.name.text
            findings.warning(
                "GB353",
                f"no event sets the discrete value `{name}`, so that it never changes",
                statement.name.span,
                help=f"write `const {name} = …`, or set it in an event, or accept it with `allow GB353 {name}`",
                subject=name,
            )
