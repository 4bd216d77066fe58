"""`allow CODE [NAME]`: warnings that the author of the model accepts."""

from __future__ import annotations

import re
from collections.abc import Iterable

from gbspec.diagnostics import Diagnostic, Findings, Severity
from gbspec.semantics.merge import Item, Merged
from gbspec.semantics.table import Table
from gbspec.semantics.vocabulary import suggestion
from gbspec.syntax import ast

Allowed = tuple[tuple[str, str | None], ...]

WARNINGS = re.compile(r"GB4\d\d|GB307|GB314|GB31[6-9]|GB331|GB55\d|GB65\d")
"""Codes that are warnings about a model."""


def allowed(items: Iterable[Item], table: Table, findings: Findings, merged: Merged) -> Allowed:
    """The accepted warnings; an error if a code is not a warning's, or a name is not declared."""
    accepted: list[tuple[str, str | None]] = []
    for item in items:
        if not isinstance(item.statement, ast.AllowStatement):
            continue
        code, name = item.statement.code, item.statement.name
        if not WARNINGS.fullmatch(code.text):
            error = re.fullmatch(r"GB\d\d\d", code.text)
            findings.error(
                "GB234",
                f"`{code.text}` cannot be accepted" + (": it is an error" if error else ": no warning has this code"),
                code.span,
                help="`allow` takes the code of a warning as shown in brackets, such as `allow GB403`",
            )
        elif name is not None and name.text not in table and merged.lacks(name.text):
            findings.error(
                "GB201",
                f"undeclared name `{name.text}`",
                name.span,
                label="not declared",
                help=suggestion(name.text, table) or f"to accept every `{code.text}`, leave the name out",
                subject=name.text,
            )
        else:
            accepted.append((code.text, name.text if name is not None else None))
    return tuple(accepted)


def is_accepted(diagnostic: Diagnostic, accepted: Allowed) -> bool:
    """Whether a diagnostic is a warning that an `allow` names."""
    return diagnostic.severity is Severity.WARNING and any(
        code == diagnostic.code and name in (None, diagnostic.subject) for code, name in accepted
    )
