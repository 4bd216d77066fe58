"""`gbspec sweep MODEL DATA -o DIR --vary NAME=VALUE,VALUE`: one run for each combination of options, and a table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.commands.train import target
from gbspec.cli.frame import command
from gbspec.cli.interruption import continued
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.diagnostics import Findings
from gbspec.report import number, table
from gbspec.training import TrainOptions, points


@command(
    "sweep",
    "gbspec sweep my_model.gb data.csv -o my_sweep --vary max_step=0.05,0.1 --vary effort=low,normal",
    "gbspec sweep urp_gb2 urp.csv -o holdouts --vary seed=0,1,2 --holdout 0.2 --workers 3",
    "gbspec sweep urp_gb2 urp.csv -o urp_sweep --vary ridge=0,1,2 --scheduler tcp://head:8786 --resume",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb).", metavar="MODEL")],
    data: Annotated[str, typer.Argument(help="A table of measurements.", metavar="DATA")],
    to: Annotated[
        str, typer.Option("--output", "-o", help="The directory of the runs and their table.", metavar="DIR")
    ],
    vary: Annotated[
        list[str],
        typer.Option(
            "--vary",
            help="An option of training and its values; repeat for all combinations of several options.",
            metavar="NAME=V,V…",
        ),
    ],
    options: TrainOptions,
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Train a model with every combination of some options, one run directory each, and compare the results.

    Other options of `gbspec train` apply to all runs. `sweep.csv` has a row for each run. `--resume` continues an
    interrupted sweep: finished members are not fitted again, and new values may be added.
    """
    from gbspec import frontend
    from gbspec.cli.progress import shown
    from gbspec.operations import fitting, models, tables

    findings = Findings()
    directory = target(to, resume=options.resume)
    chosen = points(vary, options, findings)
    findings.raise_if_failed()
    specified = models.specified(frontend.load_model(model, findings), settings(set_values))
    measured = tables.read_data(data, specified, findings, form=form)
    output.findings(findings)
    with continued(directory), shown(output) as progress:
        rows = fitting.sweep(specified, measured, chosen, directory, options, progress)
    output.say(f"wrote {Path(to) / 'sweep.csv'}")
    header = [name for name in max((row.numbers for row in rows), key=len) if name not in chosen[0].varied]
    cells = [[row.run, *(number(row.numbers.get(name)) for name in header)] for row in rows]
    output.result(table(["run", *header], cells))
    output.document({"runs": [row.to_json() for row in rows]})
