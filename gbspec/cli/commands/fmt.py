"""`gbspec fmt FILE...`: writes model files in the standard form."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import WRONG_INPUT, ExitWith, command
from gbspec.cli.output import Output


@command("fmt", "gbspec fmt my_model.gb", "gbspec fmt --check models/*.gb")
def run(
    output: Output,
    files: Annotated[list[str], typer.Argument(help="Model files.", metavar="FILE")],
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; exit 1 if a file is not in the standard form.")
    ] = False,
    diff: Annotated[
        bool, typer.Option("--diff", help="Write nothing; show the changes, exit 1 if there are any.")
    ] = False,
) -> None:
    """Format model files: order of clauses, spacing and line breaks; comments are kept."""
    from gbspec.diagnostics import Diagnostic, UserError
    from gbspec.files import write_text
    from gbspec.syntax import format_text, read_source

    found: list[Diagnostic] = []
    changed: list[str] = []
    for name in files:
        try:
            source = read_source(name)
            formatted = format_text(source)
        except UserError as error:  # the other files are still formatted
            found.extend(error.diagnostics)
            continue
        # compares bytes: a BOM or CRLF is not in the standard form
        if formatted.encode() == Path(source.path).read_bytes():
            continue
        changed.append(source.path)
        if diff:
            output.result(_difference(source.text, formatted, source.path))
        elif check:
            output.result(f"{source.path} is not in the standard form")
        else:
            write_text(source.path, formatted)
            output.say(f"wrote {source.path}")
    if found:
        raise UserError(found)
    output.document({"files": [str(name) for name in files], "changed": changed})
    if changed and (check or diff):
        raise ExitWith(WRONG_INPUT)


def _difference(before: str, after: str, name: str) -> str:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), name, f"{name} (formatted)", lineterm="")
    return "\n".join(lines)
