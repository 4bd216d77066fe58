"""`gbspec predict RUN DATA -o PREDICTIONS`: predicts trajectories that were not used in training."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.diagnostics import Diagnostic, UserError


@command(
    "predict",
    "gbspec predict my_run new.csv -o predictions.csv",
    "gbspec predict my_run new.csv -o predictions.csv --window 5",
    "gbspec predict my_run new.csv -o predictions.csv --from-start",
)
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    data: Annotated[str, typer.Argument(help="A table; rows may have no measurements.", metavar="DATA")],
    to: Annotated[
        str, typer.Option("--output", "-o", help="The table: .csv, .tsv or .parquet.", metavar="PREDICTIONS")
    ],
    from_start: Annotated[
        bool, typer.Option("--from-start", help="Use only the first measured row of each trajectory.")
    ] = False,
    window: Annotated[
        int | None,
        typer.Option(
            "--window",
            help="Number of measured rows from which the initial state of a new trajectory is estimated, measured "
            "first values included; default: a third of them, at least three, for values that are not measured (models "
            "with `diffusion`: all rows show each of them).",
            metavar="ROWS",
        ),
    ] = None,
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Predict trajectories from their first rows: mean, 90 % interval, and how each row was used."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, models, tables
    from gbspec.report import target

    rows = window_of(from_start, window)
    path = target(to)
    findings = Findings()
    opened = models.open_run(directory, settings(set_values), findings)
    table = tables.read_for(opened, data, findings, require_channels=False, form=form)
    output.findings(tables.said_once(findings, opened, table))
    with output.console().status("predicting"):
        found = analysing.predict(opened, table, window=rows, path=path)
    output.say(f"wrote {to}")
    output.document({"path": to, **found.to_json()})
    output.result(str(found))


def window_of(from_start: bool, window: int | None) -> int | None:
    """The rows of the window, None for the default. Raises `UserError` (GB814)."""
    if from_start and window is not None:
        message = "`--from-start` and `--window` exclude each other"
        raise UserError([Diagnostic("GB814", message, None, help="`--from-start` is the same as `--window 1`")])
    if window is not None and window < 1:
        message = f"`--window {window}` is not a number of rows"
        raise UserError([Diagnostic("GB814", message, None, help="give a whole number of at least 1")])
    return 1 if from_start else window
