"""`gbspec validate RUN [DATA]`: computes the errors of a trained model."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.diagnostics import ComputationError, Diagnostic, UserError


@command("validate", "gbspec validate my_run", "gbspec validate my_run test.csv --member 0 --json")
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    data: Annotated[str | None, typer.Argument(help="A table; default: the training data.", metavar="[DATA]")] = None,
    member: Annotated[str, typer.Option("--member", help="A member, or the mean of all.", metavar="K|mean")] = "mean",
    set_values: Settings = None,
    form: Form = "auto",
) -> None:
    """Report the errors of a run: on data, at half the step, with an adaptive solver, and against the truth."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, models, tables

    findings = Findings()
    made = models.open_run(directory, settings(set_values), findings)
    chosen = which(member)
    measured = (
        tables.training_data(made, findings) if data is None else tables.read_for(made, data, findings, form=form)
    )
    output.findings(findings)
    if data is None and measured is not None:
        output.say(f"on the training data, {measured.path or 'which the run keeps'}")
    with output.console().status("validating"):
        found = analysing.validate(made, measured, chosen)
    output.document(found.to_json())
    output.result(str(found))
    if found.empty:
        first = found.trajectories[0]
        raise ComputationError(
            f"no trajectory can be solved, so that nothing was scored: {first.failure}",
            where=f"trajectory {first.trajectory}",
            remedy="train with a smaller `--max-step`, or state bounds that keep the states where the model is defined",
        )


def which(member: str) -> int | Literal["mean"]:
    """The member meant by `--member`. Raises `UserError` (GB814)."""
    if member == "mean":
        return "mean"
    if member.isdigit():
        return int(member)
    help = "members count from 0; `mean` is the mean of all"
    raise UserError([Diagnostic("GB814", f"`--member {member}` is not a member", None, help=help)])
