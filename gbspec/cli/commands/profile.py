"""`gbspec profile RUN NAME`: the profile likelihood of a learned constant."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("profile", "gbspec profile my_run beta", "gbspec profile my_run beta -o beta.png --points 6")
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    name: Annotated[
        str,
        typer.Argument(
            help="A learned constant that all trajectories share, or the median or the spread of a distributed one.",
            metavar="NAME",
        ),
    ],
    to: Annotated[str | None, typer.Option("--output", "-o", help="A figure to write.", metavar="FIGURE")] = None,
    data: Annotated[
        str | None, typer.Option("--data", help="The training data, if the table was moved.", metavar="DATA")
    ] = None,
    points: Annotated[int, typer.Option("--points", help="Maximum number of values on each side.", min=1)] = 6,
    iterations: Annotated[
        int, typer.Option("--iterations", help="Maximum number of iterations of each fit.", min=1)
    ] = 60,
    member: Annotated[
        int | None, typer.Option("--member", help="A member of the run; default: the best.", metavar="K")
    ] = None,
) -> None:
    """Fix a constant at values around its estimate, refit everything else, and give its 90 % interval."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, models, reporting, tables
    from gbspec.report import form_of, save

    if to is not None:
        form_of(to)
    findings = Findings()
    opened = models.open_run(directory, findings=findings)
    measured = tables.trained_on(opened, data, findings)
    output.findings(findings)

    def said(value: float, deviance: float) -> None:
        output.say(f"{name} = {value:.6g}: deviance {deviance:.4g}")

    found = fitting.profile(opened, name, measured, member=member, points=points, iterations=iterations, progress=said)
    if to is not None:
        save(reporting.profile_figure(opened, found), to)
        output.say(f"wrote {to}")
    output.document(found.to_json())
    output.result(str(found))
