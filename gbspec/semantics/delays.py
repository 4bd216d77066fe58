"""`delay(X, tau)`: what it may delay, and where it may stand. A model that declares the name gives it its meaning."""

from __future__ import annotations

from gbspec.diagnostics import Findings
from gbspec.semantics.expressions import walk
from gbspec.semantics.sites import Site
from gbspec.semantics.table import Table
from gbspec.syntax import ANY, Kind, ast, ungrouped

DELAY = "delay"
_DELAYED = frozenset({Kind.STATE, Kind.INPUT, Kind.LET})
_USAGE = "write `delay(X, tau)`, with a state, an input or a `let` X and a positive time tau"


def is_delay(node: ast.Expression, table: Table) -> bool:
    """Whether an expression is a delay of the language."""
    return isinstance(node, ast.Call) and node.function.text == DELAY and DELAY not in table


def check(node: ast.Call, site: Site, table: Table, findings: Findings) -> None:
    """Checks the arguments of a delay and its place (GB364, GB365, GB368, GB369)."""
    if not _sound(node, site, table, findings):
        site.references.complete = False


def _sound(node: ast.Call, site: Site, table: Table, findings: Findings) -> bool:
    if len(node.arguments) != 2:
        count = len(node.arguments)
        given = f"{count} {'is' if count == 1 else 'are'} given"
        message = f"`delay` takes two arguments, what is delayed and by how much; {given}"
        findings.error("GB364", message, node.span, help=_USAGE)
        return False
    inner = next((part for a in node.arguments for part in walk(a) if is_delay(part, table)), None)
    if inner is not None:
        message = "a delay of something delayed is not offered"
        findings.error("GB368", message, inner.span, help="delay it once, by the sum of both times: `delay(X, a + b)`")
        return False
    if site.rule is not ANY:
        message = f"{site.rule.place} cannot hold a delay"
        help = "delays stand in balances, rates, `let`, functions and `observe`"
        findings.error("GB369", message, node.span, help=help)
        return False
    what, time = (ungrouped(argument) for argument in node.arguments)
    return _delayed(what, time, site, table, findings)


def _delayed(what: ast.Expression, time: ast.Expression, site: Site, table: Table, findings: Findings) -> bool:
    """Whether the first argument names something that changes in time."""
    text = " ".join(what.span.text.split())
    if not isinstance(what, ast.Name):
        number = isinstance(what, ast.Number)
        message = f"`delay` takes a name, and `{text}` is {'a number' if number else 'an expression'}"
        help = "a number is the same at all times: leave out the delay" if number else f"name it: `let a = {text}`"
        findings.error("GB365", message, what.span, help=help + ("" if number else ", and write `delay(a, …)`"))
        return False
    declaration = table.get(what.text)
    if what.text in site.formals:
        message = f"`{what.text}` is an argument here, which has no past"
        findings.error("GB365", message, what.span, help="delay a state, an input or a `let` by its own name")
        return False
    if declaration is None or declaration.kind in _DELAYED:
        return True
    named = declaration.kind in (Kind.UNKNOWN, Kind.PROCESS, Kind.FUNCTION, Kind.TABLE)
    applied = "" if declaration.kind is Kind.PROCESS else "(…)"
    help = f"name it: `let a = {what.text}{applied}`, and write `delay(a, …)`" if named else "leave out the delay"
    if declaration.kind is Kind.TIME:
        help = f"write `{what.text} - tau`"
    other = table.get(time.text) if isinstance(time, ast.Name) else None
    if isinstance(time, ast.Name) and other is not None and other.kind in _DELAYED and not named:
        help = f"what is delayed comes first: `delay({time.text}, {what.text})`"
    message = f"`delay` takes a state, an input or a `let`, and `{what.text}` is {declaration.kind.value}"
    findings.error("GB365", message, what.span, help=help)
    return False
