"""`gbspec eigen MODEL|RUN`: steady states and the Jacobian's eigenvalues."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, points, settings
from gbspec.diagnostics import Diagnostic, UserError

if TYPE_CHECKING:
    from gbspec.data import Trajectories
    from gbspec.diagnostics import Findings
    from gbspec.operations import Subject


@command(
    "eigen",
    'gbspec eigen urp_gb2 --at "x1=0.4,x2=1.2,Da=0.3"',
    'gbspec eigen my_run --steady --at "Da=0.35"',
    "gbspec eigen my_run --along data.csv --json",
    "gbspec eigen my_run --initial-states",
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A model with a truth, or a run.", metavar="MODEL|RUN")],
    at: Annotated[
        list[str] | None,
        typer.Option(
            "--at", help="A point (a category by its number, from 0); may be repeated.", metavar="NAME=VALUE,..."
        ),
    ] = None,
    along: Annotated[
        str | None, typer.Option("--along", help="Rows of a table with every state measured.", metavar="DATA")
    ] = None,
    steady: Annotated[
        bool, typer.Option("--steady", help="Search for steady states (at the conditions given by --at).")
    ] = False,
    initial_states: Annotated[
        bool,
        typer.Option(
            "--initial-states", help="For a run: compare learned, bred and true initial states along the modes."
        ),
    ] = False,
    set_values: Settings = None,
    form: Form = "auto",
    member: Annotated[
        int | None, typer.Option("--member", help="A member of the run; default: the best.", metavar="K")
    ] = None,
) -> None:
    """Compute eigenvalues of the Jacobian at points, steady states or along data; for a run also those of the truth."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import analysing, models, tables

    findings = Findings()
    given = points(at)
    subject = models.subject(source, settings(set_values), findings, member)
    if initial_states:
        compared = analysing.initial_states(subject, _trained(subject, along, findings))
        output.findings(findings)
        output.document(compared.to_json())
        output.result(str(compared))
        return
    data = (
        None if along is None else tables.read_for_subject(subject, along, findings, require_channels=False, form=form)
    )
    output.findings(findings)
    found = analysing.eigen(subject, at=given, along=data, steady=steady or not (given or along))
    output.document(found.to_json())
    output.result(str(found))


def _trained(subject: Subject, along: str | None, findings: Findings) -> Trajectories:
    """The table whose initial states were learned. Raises `UserError` (GB814, GB859) if there is none."""
    from gbspec.operations import tables

    if subject.run is None:
        help = "give a run; a model's own initial states are in the model"
        raise UserError([Diagnostic("GB814", "`--initial-states` compares what a run learned", None, help=help)])
    return tables.trained_on(subject.run, along, findings)
