"""`gbspec crossvalidate MODEL DATA -o DIR`: errors of a model's predictions of data excluded from the fit."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.diagnostics import Diagnostic, Findings, UserError
from gbspec.frames import counted
from gbspec.runs import files
from gbspec.studies import SUMMARY, CrossOptions
from gbspec.training import TrainOptions


@command(
    "crossvalidate",
    "gbspec crossvalidate theophylline theophylline.csv -o left_out",
    "gbspec crossvalidate hare_lynx hare_lynx.csv -o blocks --over time --folds 5 --members 3",
    "gbspec crossvalidate my_model.gb data.csv -o folds --folds 5 --window 4",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb).", metavar="MODEL")],
    data: Annotated[str, typer.Argument(help="A table of measurements.", metavar="DATA")],
    to: Annotated[str, typer.Option("--output", "-o", help="The directory to write to.", metavar="DIR")],
    division: CrossOptions,
    options: TrainOptions,
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Fit a model several times, each time without a part of the data, and report the errors of predicting that part.

    The parts are trajectories (their initial states and `per trajectory` constants are estimated from their first
    rows, which are excluded from the errors), or blocks of successive rows (predicted from the initial state that is
    learned from the other rows). The same command continues an interrupted cross-validation.
    """
    from gbspec import frontend
    from gbspec.cli.progress import shown
    from gbspec.operations import models, tables
    from gbspec.studies import Fold, crossvalidate
    from gbspec.training import Progress

    findings = Findings()
    directory = target(to)
    options.check(findings)
    findings.raise_if_failed()
    specified = models.specified(frontend.load_model(model, findings), settings(set_values))
    measured = tables.read_data(data, specified, findings, form=form)
    output.findings(findings)
    with ExitStack() as stack:

        def progress(fold: Fold) -> Progress:
            stack.close()  # ends the display of the previous fold
            kept = counted(len(fold.kept), "trajectory")
            output.say(f"fold {fold.number}: {kept}, {counted(fold.kept.measurements, 'value')} to fit")
            return stack.enter_context(shown(output))

        found = crossvalidate(specified, measured, directory, options, division, progress)
    output.say(f"wrote {directory / 'table.md'}")
    output.result((directory / "table.md").read_text(encoding="utf-8").rstrip("\n"))
    output.document(found.to_json())


def target(to: str) -> Path:
    """The directory; raises `UserError` (GB802, GB806) unless it is new, empty or an earlier cross-validation."""
    directory = Path(to)
    if directory.exists() and not directory.is_dir():
        message = f"`{to}` is a file; a cross-validation needs a directory"
        raise UserError([Diagnostic("GB802", message, None, help="choose another name")])
    begun = (directory / "folds" / "settings.json").is_file() or (directory / SUMMARY).is_file()
    if directory.is_dir() and not files.is_blank(directory) and not begun:
        message = f"`{to}` already exists and is not a cross-validation"
        raise UserError([Diagnostic("GB806", message, None, help="choose another name")])
    return directory
