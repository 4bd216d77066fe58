"""Runs the checks of `gbspec check` on a file open in the editor, and places the diagnostics in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from gbspec.diagnostics import Diagnostic, Findings, Label, Source, Span, UserError
from gbspec.lsp.workspace import Workspace
from gbspec.syntax import ast


@dataclass(frozen=True)
class Checked:
    """The diagnostics of a file, each placed in that file, and the values of its constants if it has no errors."""

    source: Source
    findings: tuple[Diagnostic, ...]
    values: dict[str, float]


def check(workspace: Workspace, path: str | Path) -> Checked:
    """Checks a file through the whole pipeline, with the newest texts of the files that it extends.

    Raises `UserError` if the file itself cannot be read. A diagnostic in an extended file is placed at the `extends` of
    this one, with the original place as a label.
    """
    from gbspec import frontend
    from gbspec.passes import examine

    source = workspace.source(path)
    findings = Findings()
    values: dict[str, float] = {}
    try:
        model = frontend.load_model(path, findings, workspace.source)
        examine(model, findings)
        values = {constant.name: constant.value for constant in model.constants}
    except UserError as error:
        findings.extend(error.diagnostics)
    return Checked(source, tuple(_here(d, source, workspace) for d in findings), values)


def affected(workspace: Workspace, path: str | Path) -> tuple[Path, ...]:
    """The open files whose diagnostics depend on a file: itself and those that extend it."""
    return tuple(p for p in workspace.opened() if workspace.extends(p, path))


def _here(diagnostic: Diagnostic, source: Source, workspace: Workspace) -> Diagnostic:
    """The diagnostic with a place in this text."""
    place = diagnostic.place
    if isinstance(place, Span) and place.source is source:
        return diagnostic
    where = _extends(workspace, source) or Span(
        source, 0, source.text.find("\n") if "\n" in source.text else len(source.text)
    )
    if not isinstance(place, Span):
        return replace(diagnostic, place=where)
    message = f"in `{Path(place.source.path).name}`: {diagnostic.message}"
    return replace(diagnostic, message=message, place=where, labels=(Label(place, "here"), *diagnostic.labels))


def _extends(workspace: Workspace, source: Source) -> Span | None:
    parsed = workspace.parsed(source.path)
    statements: Iterable[ast.Statement] = parsed.file.statements if parsed is not None else ()
    for statement in statements:
        if isinstance(statement, ast.ModelStatement) and statement.extends is not None:
            return statement.extends.span
    return None
