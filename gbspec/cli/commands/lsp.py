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
        bool, typer.Option("--stdio", help="Talk over standard input and output: the only way, so it changes nothing.")
    ] = True,
) -> None:
    """Serve an editor: findings as you type, hover, completion, definitions, renaming, formatting, outline."""
    try:
        import pygls  # noqa: F401 - whether the extra is installed
    except ImportError:
        print(
            "error: `gbspec lsp` needs the package `pygls`; install it with `pip install 'gbspec[lsp]'`",
            file=sys.stderr,
        )
        raise ExitWith(USAGE) from None
    from gbspec.lsp.server import serve

    serve()
