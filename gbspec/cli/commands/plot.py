"""`gbspec plot RUN KIND -o FILE`: draws a single figure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.report import KINDS, names

if TYPE_CHECKING:
    Kind = str
else:
    Kind = Literal[names()]  # the choices of the command, which a type checker cannot know

HELP = "What to draw: " + ", ".join(f"{kind.name} ({kind.help})" for kind in KINDS) + "."


@command(
    "plot",
    "gbspec plot my_run fit -o fit.png",
    "gbspec plot my_run functions -o functions.pdf",
    "gbspec plot my_run fit -o two.svg --show 3 --show 7",
)
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    kind: Annotated[Kind, typer.Argument(help=HELP, metavar="KIND")],
    to: Annotated[str, typer.Option("--output", "-o", help="The figure: .png, .svg or .pdf.", metavar="FILE")],
    data: Annotated[
        str | None, typer.Option("--data", help="A table; default: the training data.", metavar="DATA")
    ] = None,
    show: Annotated[
        list[str] | None, typer.Option("--show", help="A trajectory to show; may be repeated.", metavar="LABEL")
    ] = None,
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Draw a figure of a run: its fit, functions, constants, residuals and others, or a summary."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import models, reporting, tables
    from gbspec.report import form_of, save

    form_of(to)
    findings = Findings()
    made = models.open_run(directory, settings(set_values), findings)
    measured = (
        tables.training_data(made, findings, required=False)
        if data is None
        else tables.read_for(made, data, findings, form=form)
    )
    output.findings(findings)
    save(reporting.figure(kind, made, measured, show or ()), to)
    output.say(f"wrote {to}")
    output.document({"run": directory, "kind": kind, "path": to})
