"""`gbspec compile MODEL|RUN -o FILE`: writes the model in another form."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.flags import choice
from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.operations import forms

FORMS = forms()


@command(
    "compile",
    "gbspec compile urp_gb2.gb -o urp_gb2.py",
    "gbspec compile urp_gb2.gb --emit latex -o urp_gb2.tex",
    "gbspec compile run --emit c -o urp_gb2.c",
    "gbspec compile urp_gb2.gb --emit ast -o /dev/stdout",
    "gbspec compile urp_gb2.gb --solver dopri5 -o urp_gb2.py",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb), or a run directory.", metavar="MODEL")],
    to: Annotated[str, typer.Option("--output", "-o", help="The file to write.", metavar="FILE")],
    emit: Annotated[
        str,
        typer.Option(
            "--emit",
            parser=choice(tuple(FORMS)),
            metavar="FORM",
            help="; ".join(f"{name}: {said}" for name, said in FORMS.items()) + ".",
        ),
    ] = "module",
    solver: Annotated[
        str | None,
        typer.Option(
            "--solver",
            help="Integration method of the step in the module and the C code; default: that of the run, or `rk4`.",
            metavar="NAME",
        ),
    ] = None,
) -> None:
    """Compile a model to a standalone Python module (torch runs it, casadi analyses it, gbspec is not needed)."""
    from gbspec.diagnostics import Findings
    from gbspec.files import write_bytes
    from gbspec.operations import compile_file

    findings = Findings()
    made = compile_file(model, emit, findings, solver)
    output.findings(findings)
    write_bytes(to, made.content if isinstance(made.content, bytes) else made.content.encode("utf-8"))
    output.say(f"wrote {to}")
    output.document({"model": made.name, "emit": emit, "path": to, "class": made.class_name})
