"""`gbspec bifurcate MODEL|RUN`: steady states, Hopf points and limit cycles over one parameter, or a plane of two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Settings, settings
from gbspec.diagnostics import Diagnostic, UserError

if TYPE_CHECKING:
    from gbspec.operations import Subject

Ends = tuple[float, float]


@command(
    "bifurcate",
    "gbspec bifurcate urp_gb2 --over Da --range 0.2 0.5 --cycles -o truth.png",
    "gbspec bifurcate my_run --over beta --range 2 4 --set Da=0.35 --members all --json",
    "gbspec bifurcate my_run --over Da --range 0.05 0.6 --and B --and-range 8 14 -o plane.png",
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A model with a truth, or a run.", metavar="MODEL|RUN")],
    over: Annotated[str, typer.Option("--over", help="A condition, input or constant to vary.", metavar="NAME")],
    ends: Annotated[Ends, typer.Option("--range", help="The range of values.", metavar="LO HI")],
    second: Annotated[
        str | None,
        typer.Option(
            "--and", help="A second quantity to vary: Hopf and fold curves in the plane of both.", metavar="NAME"
        ),
    ] = None,
    second_ends: Annotated[Ends | None, typer.Option("--and-range", help="Its range.", metavar="LO HI")] = None,
    set_values: Settings = None,
    cycles: Annotated[bool, typer.Option("--cycles", help="Follow the limit cycles too.")] = False,
    doublings: Annotated[
        int,
        typer.Option(
            "--doublings", help="With --cycles: how many successive period doublings to follow.", min=0, metavar="N"
        ),
    ] = 1,
    members: Annotated[
        str, typer.Option("--members", help="A member of the run, or `all`; default: the best member.", metavar="K|all")
    ] = "best",
    to: Annotated[str | None, typer.Option("--output", "-o", help="A figure to write.", metavar="FIGURE")] = None,
) -> None:
    """Follow steady states over a parameter: branches, stability, folds, Hopf points, and limit cycles."""
    from gbspec.diagnostics import Findings
    from gbspec.operations import models
    from gbspec.report import form_of

    _require_plane(second, second_ends, cycles=cycles)
    if to is not None:
        form_of(to)
    findings, values = Findings(), settings(set_values)
    with output.console().status("following branches"):
        if models.is_run(source):
            opened = models.open_run(source, findings=findings)
            numbers = chosen(members, opened.numbers, opened.best)
            subjects = [models.learned(opened, values, member) for member in numbers]
        else:
            subjects = [models.subject(source, values, findings)]
        output.findings(findings)
        if second is None or second_ends is None:
            found = _branches(subjects, over, ends, to, cycles=cycles, doublings=doublings)
        else:
            found = _plane(subjects, (over, second), (ends, second_ends), to)
    if to is not None:
        output.say(f"wrote {to}")
    output.document(found.document)
    output.result(found.text)


@dataclass(frozen=True)
class _Found:
    """The output of the command."""

    document: dict[str, object]
    text: str


def _branches(
    subjects: Sequence[Subject], over: str, ends: Ends, to: str | None, *, cycles: bool, doublings: int
) -> _Found:
    """Diagrams over one parameter, one for each member, drawn together with that of the truth."""
    from gbspec.operations import analysing, reporting
    from gbspec.report import save

    if cycles and analysing.system(subjects[0]).delayed is not None:
        help = "leave out `--cycles`: Hopf points have the period of the cycles that are born there"
        message = "cycles of a model with delayed states are not followed"
        raise UserError([Diagnostic("GB769", message, None, help=help)])
    found = [analysing.bifurcate(subject, over, *ends, cycles=cycles, doublings=doublings) for subject in subjects]
    if to is not None:
        truth = analysing.true_diagram(subjects[0], over, *ends, cycles=cycles, doublings=doublings)
        save(reporting.diagram_figure(found, truth), to)
    shown = analysing.joined(found)
    return _Found(shown.to_json(), str(shown))


def _plane(subjects: Sequence[Subject], names: tuple[str, str], boxes: tuple[Ends, Ends], to: str | None) -> _Found:
    """Curves in the plane of two parameters, one set for each member, drawn together with those of the truth."""
    from gbspec.operations import analysing, reporting
    from gbspec.report import save

    found = [analysing.bifurcation_plane(subject, names, boxes) for subject in subjects]
    if to is not None:
        save(reporting.plane_figure(found, analysing.true_plane(subjects[0], names, boxes)), to)
    others = {"members": [one.to_json() for one in found[1:]]} if len(found) > 1 else {}
    return _Found({**found[0].to_json(), **others}, "\n".join(map(str, found)))


def _require_plane(second: str | None, ends: Ends | None, *, cycles: bool) -> None:
    """Raises `UserError` (GB814) if the options of a plane are inconsistent."""
    if (second is None) != (ends is None):
        message, help = "`--and` and `--and-range` must be given together", "give both: `--and B --and-range 8 14`"
    elif second is not None and cycles:
        message = "`--cycles` has no meaning in a plane of two parameters"
        help = "leave `--cycles` out, or draw cycles over one parameter without `--and`"
    else:
        return
    raise UserError([Diagnostic("GB814", message, None, help=help)])


def chosen(members: str, numbers: tuple[int, ...], best: int) -> tuple[int, ...]:
    """The members meant by `--members`. Raises `UserError` (GB814)."""
    if members == "all":
        # The best member comes first: intervals are given for its points.
        return (best, *(number for number in numbers if number != best))
    if members == "best":
        return (best,)
    if members.isdigit():
        return (int(members),)
    help = "give a number, counted from 0, or `all`"
    raise UserError([Diagnostic("GB814", f"`--members {members}` is not a member", None, help=help)])
