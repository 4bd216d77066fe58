"""The outline: the names of a file, grouped by kind of statement."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.diagnostics import Span
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
    statement: type[ast.Statement]
    entries: tuple[Entry, ...]


def outline(file: ast.File) -> tuple[Group, ...]:
    """The statements of a file, by kind; empty kinds are left out."""
    found: dict[type[ast.Statement], list[Entry]] = {kind: [] for kind in ast.STATEMENTS}
    for statement in file.statements:
        found[type(statement)].extend(_entries(statement))
    return tuple(
        Group(kind.entry.title, kind, tuple(entries))
        for kind, entries in found.items()
        if entries and kind.entry.title is not None
    )


def _entries(statement: ast.Statement) -> list[Entry]:
    text = getattr(statement, "description", None) or getattr(statement, "title", None)
    detail = text.value if isinstance(text, ast.Text) else statement.entry.role.split(",")[0]
    return [Entry(name, detail, statement.span, span) for name, span in statement.outlined()]
