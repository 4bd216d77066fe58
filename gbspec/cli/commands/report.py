"""`gbspec report RUN`: writes an HTML page about a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.diagnostics import Diagnostic, UserError


@command(
    "report",
    "gbspec report my_run",
    "gbspec report my_run -o my_run.html --over Da --range 0.2 0.5",
)
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    to: Annotated[
        str | None,
        typer.Option("--output", "-o", help="The file to write; default: RUN/report.html.", metavar="FILE.html"),
    ] = None,
    data: Annotated[
        str | None, typer.Option("--data", help="A table; default: the training data.", metavar="DATA")
    ] = None,
    over: Annotated[
        str | None, typer.Option("--over", help="Draw a bifurcation diagram over this quantity.", metavar="NAME")
    ] = None,
    ends: Annotated[tuple[float, float] | None, typer.Option("--range", help="Its range.", metavar="LO HI")] = None,
    cycles: Annotated[bool, typer.Option("--cycles", help="Follow the limit cycles too.")] = False,
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Write one self-contained page: model, fit, learned functions and constants, errors, how to reproduce the run."""
    from gbspec.diagnostics import Findings
    from gbspec.files import writable
    from gbspec.operations import models, reporting, tables

    if (over is None) != (ends is None):
        message = "`--over` and `--range` must be given together"
        raise UserError([Diagnostic("GB814", message, None, help="give both: `--over Da --range 0.2 0.5`")])
    findings = Findings()
    opened = models.open_run(directory, settings(set_values), findings)
    path = writable(to if to is not None else Path(directory) / "report.html")
    table = (
        tables.training_data(opened, findings) if data is None else tables.read_for(opened, data, findings, form=form)
    )
    output.findings(findings)
    diagram = None if over is None or ends is None else (over, *ends)
    with output.console().status("writing the report"):
        reporting.report(opened, table, path, diagram=diagram, cycles=cycles)
    output.say(f"wrote {path}")
    output.document({"run": directory, "path": path, "bytes": path.stat().st_size})
