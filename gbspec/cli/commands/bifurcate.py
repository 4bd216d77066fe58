"""`gbspec bifurcate MODEL|RUN`: steady states, Hopf points and limit cycles over one parameter."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Settings, settings
from gbspec.diagnostics import Diagnostic, UserError

if TYPE_CHECKING:
    from gbspec.analysis.bifurcate import Diagram


@command(
    "bifurcate",
    "gbspec bifurcate urp_gb2 --over Da --range 0.2 0.5 --cycles -o truth.png",
    "gbspec bifurcate my_run --over beta --range 2 4 --set Da=0.35 --members all --json",
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A model with a truth, or a run.", metavar="MODEL|RUN")],
    over: Annotated[str, typer.Option("--over", help="A condition, input or constant to vary.", metavar="NAME")],
    ends: Annotated[tuple[float, float], typer.Option("--range", help="From where to where.", metavar="LO HI")],
    set_values: Settings = None,
    cycles: Annotated[bool, typer.Option("--cycles", help="Follow the limit cycles too.")] = False,
    members: Annotated[
        str, typer.Option("--members", help="A member of the run (else the best), or `all`.", metavar="K|all")
    ] = "best",
    to: Annotated[str | None, typer.Option("--output", "-o", help="A figure to write.", metavar="FIGURE")] = None,
) -> None:
    """Follow steady states over a parameter: branches, stability, folds, Hopf points, and the cycles they lead to."""
    from gbspec import driver
    from gbspec.diagnostics import Findings
    from gbspec.report.style import form_of, save

    if to is not None:
        form_of(to)
    findings, values = Findings(), settings(set_values)
    with output.console().status("following branches"):
        if driver.is_run(source):
            opened = driver.open_run(source)
            subjects = [
                driver.learned(opened, values, member) for member in chosen(members, opened.numbers, opened.best)
            ]
        else:
            subjects = [driver.subject(source, values, findings)]
        output.findings(findings)
        found: list[Diagram] = [driver.bifurcate(subject, over, *ends, cycles=cycles) for subject in subjects]
        if to is not None:
            truth = driver.true_diagram(subjects[0], over, *ends, cycles=cycles)
            save(driver.diagram_figure(found, truth), to)
            output.say(f"wrote {to}")
    shown = driver.joined(found)
    output.document(shown.to_json())
    output.result(str(shown))


def chosen(members: str, numbers: tuple[int, ...], best: int) -> tuple[int, ...]:
    """The members meant by `--members`. Raises `UserError` (GB814)."""
    if members == "all":
        return numbers
    if members == "best":
        return (best,)
    if members.isdigit():
        return (int(members),)
    help = "give a number, counted from 0, or `all`"
    raise UserError([Diagnostic("GB814", f"`--members {members}` is not a member", None, help=help)])
