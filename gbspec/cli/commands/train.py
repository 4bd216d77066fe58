"""`gbspec train MODEL DATA -o RUN`: learns the unknown functions and constants of a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.interruption import continued
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.report import run_summary
from gbspec.training import TrainOptions


@command(
    "train",
    "gbspec train my_model.gb data.csv -o my_run",
    "gbspec train urp_gb2 urp.csv -o urp_run --members 3 --max-step 0.1 --effort high",
    "gbspec train urp_gb2 urp.csv -o urp_run --resume",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb).", metavar="MODEL")],
    data: Annotated[str, typer.Argument(help="A table of measurements.", metavar="DATA")],
    to: Annotated[str, typer.Option("--output", "-o", help="The run directory to create.", metavar="RUN")],
    options: TrainOptions,
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Learn the unknown functions and constants of a model from a table, into a run directory."""
    from gbspec import frontend
    from gbspec.cli.progress import shown
    from gbspec.operations import fitting, models, tables

    findings = Findings()
    directory = target(to, resume=options.resume)
    options.check(findings)
    findings.raise_if_failed()
    output.say(f"reading {model}")
    specified = models.specified(frontend.load_model(model, findings), settings(set_values))
    output.say(f"reading {data}")
    measured = tables.read_data(data, specified, findings, form=form)
    output.findings(findings)
    with continued(directory), shown(output) as progress:
        made = fitting.train(specified, measured, directory, options, progress)
    output.say(f"wrote {to}")
    output.result(run_summary(made))
    output.document(made.fit.to_json())


def target(to: str, *, resume: bool) -> Path:
    """The directory if a run may be written there; otherwise raises `UserError` (GB802, GB806)."""
    from gbspec.training import unbegun

    directory = Path(to)
    if directory.exists() and not directory.is_dir():
        message = f"`{to}` is a file; a run needs a directory"
        raise UserError([Diagnostic("GB802", message, None, help="choose another name")])
    if directory.is_dir() and not resume and not unbegun(directory):
        message = f"`{to}` already exists and is not empty"
        help = "choose another name, remove it, or continue an interrupted run with `--resume`"
        raise UserError([Diagnostic("GB806", message, None, help=help)])
    return directory
