"""`gbspec profile RUN NAME`: what the data say of one constant, everything else fitted to it."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("profile", "gbspec profile my_run beta", "gbspec profile my_run beta -o beta.png --points 6")
def run(
    output: Output,
    directory: Annotated[str, typer.Argument(help="A run directory.", metavar="RUN")],
    name: Annotated[str, typer.Argument(help="A learned constant that all trajectories share.", metavar="NAME")],
    to: Annotated[str | None, typer.Option("--output", "-o", help="A figure to write.", metavar="FIGURE")] = None,
    data: Annotated[
        str | None, typer.Option("--data", help="The table, if it was moved since training.", metavar="DATA")
    ] = None,
    points: Annotated[int, typer.Option("--points", help="Most values to either side.", min=1)] = 6,
    iterations: Annotated[int, typer.Option("--iterations", help="Most steps of each fit.", min=1)] = 60,
    member: Annotated[
        int | None, typer.Option("--member", help="Which member of the run; the best.", metavar="K")
    ] = None,
) -> None:
    """Hold a constant at values around its estimate, fit the rest anew, and give its 90 % interval."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import fitting, models, reporting, tables
    from gbspec.report.style import form_of, save

    if to is not None:
        form_of(to)
    findings = Findings()
    opened = models.open_run(directory)
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
