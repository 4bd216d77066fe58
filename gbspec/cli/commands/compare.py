"""`gbspec compare RUN RUN…`: likelihoods of runs of the same data."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("compare", "gbspec compare my_run my_run_with_correlation", "gbspec compare run_1 run_2 run_3 --json")
def run(
    output: Output,
    directories: Annotated[
        list[str], typer.Argument(help="Run directories, fitted to the same data.", metavar="RUN...")
    ],
) -> None:
    """Compare likelihoods, AIC and BIC of runs of the same data, test nested ones, and say what differs."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import comparing, models

    findings = Findings()
    opened = [models.open_run(directory, findings=findings) for directory in directories]
    output.findings(findings)
    found = comparing.compare(opened)
    output.document(found.to_json())
    output.result(str(found))
