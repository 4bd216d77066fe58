"""`gbspec completion SHELL`: a script that completes command lines of gbspec."""

from __future__ import annotations

import importlib
from typing import Annotated, Literal

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("completion", "gbspec completion bash", "gbspec completion zsh", "gbspec completion fish")
def run(
    output: Output,
    shell: Annotated[Literal["bash", "zsh", "fish"], typer.Argument(help="bash, zsh or fish.", metavar="SHELL")],
) -> None:
    """Print a script that completes commands, options, their values, and names of bundled models.

    Save it where the shell looks for such scripts, and open a new shell; save it again after an update of gbspec:

    - bash: `~/.local/share/bash-completion/completions/gbspec`
    - zsh: `_gbspec` in a folder of `$fpath`, such as `~/.zfunc`
    - fish: `~/.config/fish/completions/gbspec.fish`
    """
    from gbspec.cli.app import COMMANDS
    from gbspec.cli.completion import script, words
    from gbspec.data import shipped_models

    models = tuple(shipped_models())
    text = script(shell, {name: words(importlib.import_module(m).run, models) for name, m in COMMANDS.items()})
    output.document({"shell": shell, "script": text})
    output.result(text.rstrip("\n"))
