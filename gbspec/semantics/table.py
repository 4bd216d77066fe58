"""The table of a model's names, each declared once."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.diagnostics import Findings, Label, Span
from gbspec.semantics.merge import Item
from gbspec.syntax import Kind, ast


@dataclass(frozen=True)
class Declaration:
    """A name, its kind, and the statement that declares it."""

    name: str
    kind: Kind
    statement: ast.Statement | None
    span: Span | None
    output: int = 0
    """For an unknown: the index of its output in the statement's network."""


Table = dict[str, Declaration]


def build(items: tuple[Item, ...], findings: Findings) -> Table:
    """Every declared name with its first declaration; a second one is an error."""
    time = next((i.statement for i in items if isinstance(i.statement, ast.TimeStatement)), None)
    table: Table = {}
    name = ast.Name(time.name.span, time.name.text) if time is not None else None
    clock = name.text if name is not None else "t"
    table[clock] = Declaration(clock, Kind.TIME, time, name.span if name is not None else None)
    for item in items:
        for declaration, at in _declarations(item.statement):
            first = table.setdefault(at.text, declaration)
            if first is not declaration:
                _duplicate(at, first, findings)
                if first.kind is Kind.TIME or declaration.kind is Kind.STATE:
                    table[at.text] = declaration  # more likely the one that the rest of the text refers to
    _time_once(items, findings)
    return table


def _declarations(statement: ast.Statement) -> list[tuple[Declaration, ast.Name]]:
    """The declarations of a statement, except the time, which is declared before all others."""
    kind = statement.entry.kind
    if kind is None or kind is Kind.TIME:
        return []
    return [(Declaration(n.text, kind, statement, n.span, i), n) for i, n in enumerate(statement.declares())]


def _duplicate(name: ast.Name, first: Declaration, findings: Findings) -> None:
    if first.kind is Kind.TIME:
        where = "the name of the time" + ("" if first.span else ", which is `t` without a `time` statement")
        findings.error(
            "GB203",
            f"`{name.text}` is {where}",
            name.span,
            labels=[Label(first.span, "the time")] if first.span is not None else [],
            help="choose another name, or another name for the time: `time tau`",
        )
        return
    labels = [Label(first.span, "first declared here")] if first.span is not None else []
    if isinstance(first.statement, ast.StateStatement | ast.LetStatement) and _is_channel_of(name, first):
        help_ = f"to measure it directly write `observe {name.text}`; otherwise give the channel another name"
    else:
        help_ = "rename one of them, or delete it"
    findings.error("GB202", f"`{name.text}` is declared twice", name.span, label="again", labels=labels, help=help_)


def _is_channel_of(name: ast.Name, first: Declaration) -> bool:
    line = name.span.source.line(name.span.position[0])
    return line.startswith("observe") and first.name == name.text


def _time_once(items: tuple[Item, ...], findings: Findings) -> None:
    for kind, code in ((ast.TimeStatement, "time"), (ast.ModelStatement, "model")):
        found = [i.statement for i in items if isinstance(i.statement, kind)]
        for again in found[1:]:
            findings.error(
                "GB202",
                f"a second `{code}` statement",
                again.span,
                labels=[Label(found[0].span, "the first")],
                help="a model has one; delete one of them",
            )
