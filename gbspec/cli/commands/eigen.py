"""`gbspec eigen MODEL|RUN`: steady states and the Jacobian's eigenvalues."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Settings, points, settings


@command(
    "eigen",
    'gbspec eigen urp_gb2 --at "x1=0.4,x2=1.2,Da=0.3"',
    'gbspec eigen my_run --steady --at "Da=0.35"',
    "gbspec eigen my_run --along data.csv --json",
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A model with a truth, or a run.", metavar="MODEL|RUN")],
    at: Annotated[
        list[str] | None, typer.Option("--at", help="A point; may be repeated.", metavar="NAME=VALUE,...")
    ] = None,
    along: Annotated[
        str | None, typer.Option("--along", help="Rows of a table with every state measured.", metavar="DATA")
    ] = None,
    steady: Annotated[
        bool, typer.Option("--steady", help="Search for steady states (at the conditions that --at gives).")
    ] = False,
    set_values: Settings = None,
    member: Annotated[
        int | None, typer.Option("--member", help="Which member of a run; the best.", metavar="K")
    ] = None,
) -> None:
    """Give the eigenvalues of the Jacobian at points, at steady states or along data; of a run beside the truth's."""
    from gbspec import driver
    from gbspec.diagnostics import Findings

    findings = Findings()
    given = points(at)
    subject = driver.subject(source, settings(set_values), findings, member)
    data = None if along is None else driver.read_data(along, subject.model, findings, require_channels=False)
    output.findings(findings)
    found = driver.eigen(subject, at=given, along=data, steady=steady or not (given or along))
    output.document(found.to_json())
    output.result(str(found))
