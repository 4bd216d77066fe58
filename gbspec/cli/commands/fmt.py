"""`gbspec fmt FILE...`: writes model files in the standard form."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import WRONG_INPUT, ExitWith, command
from gbspec.cli.output import Output
from gbspec.cli.standard_input import STANDARD_INPUT, read


@command("fmt", "gbspec fmt my_model.gb", "gbspec fmt --check models/*.gb", "gbspec fmt - < my_model.gb > formatted.gb")
def run(
    output: Output,
    files: Annotated[list[str], typer.Argument(help="Model files, - for standard input.", metavar="FILE")],
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; exit 1 if a file is not in the standard form.")
    ] = False,
    diff: Annotated[
        bool, typer.Option("--diff", help="Write nothing; show the changes, exit 1 if there are any.")
    ] = False,
) -> None:
    """Format model files: order of clauses, spacing and line breaks; comments are kept.

    What comes from standard input is written to standard output.
    """
    from gbspec.diagnostics import Diagnostic, UserError
    from gbspec.files import write_text
    from gbspec.syntax import format_text

    found: list[Diagnostic] = []
    changed: list[str] = []
    answer: dict[str, object] = {"files": [str(name) for name in files], "changed": changed}
    for name in files:
        try:
            source = read(name)
            formatted = format_text(source)
        except UserError as error:  # the other files are still formatted
            found.extend(error.diagnostics)
            continue
        if name == STANDARD_INPUT and not (check or diff):
            answer["formatted"] = formatted
            output.result(formatted.removesuffix("\n"))
        # compares bytes: a BOM or CRLF is not in the standard form
        if formatted.encode() == (source.text.encode() if name == STANDARD_INPUT else Path(name).read_bytes()):
            continue
        changed.append(source.path)
        if diff:
            output.result(_difference(source.text, formatted, source.path))
        elif check:
            output.result(f"{source.path} is not in the standard form")
        elif name != STANDARD_INPUT:
            write_text(source.path, formatted)
            output.say(f"wrote {source.path}")
    if found:
        raise UserError(found)
    output.document(answer)
    if changed and (check or diff):
        raise ExitWith(WRONG_INPUT)


def _difference(before: str, after: str, name: str) -> str:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), name, f"{name} (formatted)", lineterm="")
    return "\n".join(lines)
