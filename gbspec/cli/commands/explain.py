"""`gbspec explain CODE`: explains a diagnostic code."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("explain", "gbspec explain GB201")
def run(output: Output, code: Annotated[str, typer.Argument(help="A code, such as GB201.", metavar="CODE")]) -> None:
    """Explain a diagnostic: its meaning, a minimal example that causes it, and the corrected example."""
    from gbspec.diagnostics import explain

    entry = explain(code.strip().upper())
    output.document(entry)
    parts = [f"{entry.code}: {entry.title}", entry.explanation.strip()]
    if entry.wrong.strip():
        parts.append("Wrong:\n" + _indented(entry.wrong))
    if entry.right.strip():
        parts.append("Right:\n" + _indented(entry.right))
    output.result("\n\n".join(parts))


def _indented(text: str) -> str:
    return "\n".join(f"    {line}".rstrip() for line in text.strip("\n").splitlines())
