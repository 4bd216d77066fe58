"""`gbspec lsp`: the language server that editors start."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("lsp", "gbspec lsp")
def run(
    output: Output,
    stdio: Annotated[
        bool,
        typer.Option(
            "--stdio", help="Use standard input and output; this is the only mode, and the flag has no effect."
        ),
    ] = True,
) -> None:
    """Run the language server for an editor: diagnostics, hover, completion, definitions, renaming, formatting."""
    from gbspec.lsp import serve

    serve()
