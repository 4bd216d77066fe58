"""`observe r = X'`: a measured rate of change stands for the right side of the state's balance.

The balance takes its place before names and units are checked, so that all that follows sees an ordinary expression.
What arrives at the time of a measurement (a dose) is no part of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

from gbspec.diagnostics import Findings
from gbspec.semantics.expressions import walk
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.rewriting import rebuilt, with_expressions
from gbspec.syntax import Place, ast, target_name


def expand(merged: Merged, findings: Findings) -> Merged:
    """The statements with each `X'` in `observe` replaced by the balance of X; elsewhere it is an error (GB139)."""
    if not any(_has_rate(place) for item in merged.items for place in item.statement.places()):
        return merged
    balances = _balances(merged.items)
    disturbed, infused = _others(merged.items)

    def put(item: Item) -> Item:
        def change(place: Place) -> ast.Expression:
            return rebuilt(
                place.expression, lambda node: _value(node, item, balances, disturbed, infused, findings), _is_rate
            )

        return Item(with_expressions(item.statement, change), item.text)

    return replace(merged, items=tuple(put(item) for item in merged.items))


def _others(items: Iterable[Item]) -> tuple[set[str], set[str]]:
    """The states with random disturbances, and those with infusions."""
    disturbed, infused = set(), set()
    for statement in (item.statement for item in items):
        if isinstance(statement, ast.DiffusionStatement):
            disturbed.add(target_name(statement.target).text)
        elif isinstance(statement, ast.DoseStatement) and statement.duration is not None:
            infused.add(target_name(statement.target).text)
    return disturbed, infused


def _is_rate(node: ast.Expression) -> bool:
    return isinstance(node, ast.RateOf)


def _has_rate(place: Place) -> bool:
    return any(_is_rate(node) for node in walk(place.expression))


def _balances(items: Iterable[Item]) -> dict[str, ast.Expression]:
    """The right side of each state's balance; `net(X)` for a state without one."""
    found: dict[str, ast.Expression] = {}
    for item in items:
        statement = item.statement
        if isinstance(statement, ast.StateStatement):
            name = statement.declarator.name
            found.setdefault(name.text, ast.Call(name.span, ast.Name(name.span, "net"), (name,)))
    for item in items:
        statement = item.statement
        if isinstance(statement, ast.BalanceStatement):
            found[target_name(statement.target).text] = statement.value
    return found


def _value(
    node: ast.Expression,
    item: Item,
    balances: Mapping[str, ast.Expression],
    disturbed: Collection[str],
    infused: Collection[str],
    findings: Findings,
) -> ast.Expression:
    if not isinstance(node, ast.RateOf):
        return node
    name = target_name(node.target)
    if not isinstance(item.statement, ast.ObserveStatement):
        help = "give its expression a name, `let r = …`, and use that here and in the balance"
        findings.error("GB139", "a rate of change may stand only in `observe`", node.span, help=help)
    elif name.text not in balances:
        help = "only a state has a rate of change; a measured derivative of something else is written out"
        findings.error("GB139", f"`{name.text}` is not a state", name.span, label="no balance", help=help)
    elif name.text in disturbed:
        message = f"`{name.text}` has a `diffusion`, and so no rate of change that could be measured"
        findings.error("GB344", message, node.span, help="measure the state, or leave out its diffusion")
    elif name.text in infused:
        message = f"`{name.text}` has infusions (`dose … over`), which its measured rate of change would contain"
        help = "measure the state, or declare an `input`, the rate of infusion, and add it to the balance"
        findings.error("GB430", message, node.span, help=help)
    elif not any(_is_rate(part) for part in walk(balances[name.text])):
        return ast.Group(node.span, balances[name.text])
    return ast.Number(node.span, "0")
