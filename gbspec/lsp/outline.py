"""The names of a file, grouped by what they are."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from gbspec.diagnostics import Span
from gbspec.lsp.hover import ROLES
from gbspec.lsp.index import names_declared
from gbspec.semantics.merge import target_text
from gbspec.syntax import ast


@dataclass(frozen=True)
class Entry:
    """One declared name: `span` is its statement, `name_span` the name in it."""

    name: str
    detail: str
    span: Span
    name_span: Span


@dataclass(frozen=True)
class Group:
    """The names of one kind, in the order of the text."""

    title: str
    statement: type[ast.Node]
    entries: tuple[Entry, ...]


GROUPS: dict[type[ast.Node], str] = {
    ast.ModelStatement: "model",
    ast.TimeStatement: "time",
    ast.UnitStatement: "units",
    ast.StateStatement: "states",
    ast.ConditionStatement: "conditions",
    ast.InputStatement: "inputs",
    ast.ConstStatement: "constants",
    ast.LearnStatement: "learnable constants",
    ast.LetStatement: "named expressions",
    ast.FunctionStatement: "functions",
    ast.UnknownStatement: "unknown functions",
    ast.ProcessStatement: "processes",
    ast.BalanceStatement: "balances",
    ast.ClosureStatement: "ends of arrays",
    ast.InitialStatement: "starts",
    ast.DoseStatement: "doses",
    ast.ObserveStatement: "measured channels",
    ast.ConserveStatement: "claims",
    ast.TruthStatement: "truths",
}
"""What each kind of statement is called when there are several, in the order in which they are listed."""


def outline(file: ast.File) -> tuple[Group, ...]:
    """What a file declares and says, by kind; kinds that it does not have are left out."""
    found: dict[type[ast.Node], list[Entry]] = {kind: [] for kind in GROUPS}
    for statement in file.statements:
        if type(statement) in found:
            found[type(statement)].extend(_entries(statement))
    return tuple(Group(GROUPS[kind], kind, tuple(entries)) for kind, entries in found.items() if entries)


def _entries(statement: ast.Statement) -> Iterable[Entry]:
    text = getattr(statement, "description", None) or getattr(statement, "title", None)
    detail = text.value if isinstance(text, ast.Text) else ROLES.get(type(statement), "").split(",")[0]
    match statement:
        case ast.BalanceStatement(target=target):
            named: tuple[tuple[str, Span], ...] = ((f"{target_text(target)}'", target.span),)
        case (
            ast.ClosureStatement(target=target)
            | ast.InitialStatement(target=target)
            | ast.DoseStatement(target=target)
            | ast.ObserveStatement(target=target)
        ):
            named = ((target_text(target), target.span),)
        case ast.ModelStatement(name=name) | ast.UnitStatement(name=name) | ast.TruthStatement(name=name):
            named = ((name.text, name.span),)
        case _:
            named = tuple((name.text, name.span) for name in names_declared(statement))
    return [Entry(name, detail, statement.span, span) for name, span in named]
