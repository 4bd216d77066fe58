"""`gbspec evaluate MODEL|RUN DATA`: the objective at a point."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Settings, settings


@command(
    "evaluate",
    "gbspec evaluate my_model.gb data.csv --set k=0.3",
    "gbspec evaluate my_run data.csv --json",
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A model, or a run.", metavar="MODEL|RUN")],
    data: Annotated[str, typer.Argument(help="A table of measurements.", metavar="DATA")],
    set_values: Settings = None,
    member: Annotated[
        int | None, typer.Option("--member", help="A member of the run; default: the best.", metavar="K")
    ] = None,
) -> None:
    """Evaluate the likelihood of data at a point: its negative logarithm, chi-squared, residuals and the gradient.

    Whole solutions are compared with the data, whose noise the model or the table states; nothing is fitted. Of a
    population it is the marginal likelihood, of a model with `diffusion` that of the innovations.
    """
    from gbspec import frontend
    from gbspec.diagnostics import Findings
    from gbspec.operations import evaluating, models, tables

    findings, values = Findings(), settings(set_values)
    if models.is_run(source):
        made = models.open_run(source, findings=findings)
        table = tables.read_for(made, data, findings)
        output.findings(findings)
        found = evaluating.of_run(made, table, values, member)
    else:
        model = frontend.load_model(source, findings)
        table = tables.read_data(data, model, findings)
        output.findings(findings)
        found = evaluating.of_model(model, table, values)
    output.findings(found.warnings)
    output.document(found.to_json())
    output.result(str(found))
