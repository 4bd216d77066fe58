"""`gbspec plot RUN KIND -o FILE`: draws a single figure."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Settings, settings

Kind = Literal[
    "fit", "functions", "function", "constants", "history", "residuals", "phase", "initial-states", "summary"
]
"""The kinds of `gbspec.report.figures`, which is not imported to show the help."""


@command(
    "plot",
    "gbspec plot my_run fit -o fit.png",
    "gbspec plot my_run functions -o functions.pdf",
    "gbspec plot my_run fit -o two.svg --show 3 --show 7",
)
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    kind: Annotated[Kind, typer.Argument(help="What to draw.", metavar="KIND")],
    to: Annotated[str, typer.Option("--output", "-o", help="The figure: .png, .svg or .pdf.", metavar="FILE")],
    data: Annotated[
        str | None, typer.Option("--data", help="A table; default: the training data.", metavar="DATA")
    ] = None,
    show: Annotated[
        list[str] | None, typer.Option("--show", help="A trajectory to show; may be repeated.", metavar="LABEL")
    ] = None,
    set_values: Settings = None,
) -> None:
    """Draw a figure of a run: its fit, functions, constants, residuals and others, or a summary."""
    from gbspec import driver
    from gbspec.diagnostics import Findings
    from gbspec.report.style import form_of, save

    form_of(to)
    findings = Findings()
    made = driver.open_run(directory, settings(set_values))
    measured = driver.training_data(made, findings) if data is None else driver.read_data(data, made.model, findings)
    output.findings(findings)
    save(driver.figure(kind, made, measured, show or ()), to)
    output.say(f"wrote {to}")
    output.document({"run": directory, "kind": kind, "path": to})
