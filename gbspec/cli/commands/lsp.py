"""`gbspec lsp`: the language server that editors start."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from gbspec.cli.frame import USAGE, ExitWith, command
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
    try:
        import pygls  # noqa: F401 - whether the extra is installed
    except ImportError:
        print(
            "error: `gbspec lsp` needs the package `pygls`; install it with `pip install 'gbspec[lsp]'`",
            file=sys.stderr,
        )
        raise ExitWith(USAGE) from None
    from gbspec.lsp import serve

    serve()
