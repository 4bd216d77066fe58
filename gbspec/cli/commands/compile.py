"""`gbspec compile MODEL|RUN -o FILE`: writes the model in another form."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output

Form = Literal["module", "ir", "latex", "c"]
"""The names of `gbspec.backends.registry.BACKENDS`, which is not imported to show the help."""


@command(
    "compile",
    "gbspec compile urp_gb2.gb -o urp_gb2.py",
    "gbspec compile urp_gb2.gb --emit latex -o urp_gb2.tex",
    "gbspec compile run --emit c -o urp_gb2.c",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb), or a run directory.", metavar="MODEL")],
    to: Annotated[str, typer.Option("--output", "-o", help="The file to write.", metavar="FILE")],
    emit: Annotated[
        Form,
        typer.Option(
            "--emit",
            help="module: a Python module; ir: the compiler's intermediate representation as text; latex: a page of "
            "typeset equations; c: right-hand side, Jacobian and step in C, with the values of a run or of the truth.",
        ),
    ] = "module",
) -> None:
    """Compile a model to a standalone Python module (torch runs it, casadi analyses it, gbspec is not needed)."""
    from gbspec import driver
    from gbspec.backends.module import class_name
    from gbspec.backends.registry import BACKENDS
    from gbspec.diagnostics import Findings
    from gbspec.files import write_text

    findings = Findings()
    backend = BACKENDS[emit]
    if backend.numbers:
        subject = driver.subject(model, {}, findings)
        compiled, instance = subject.model, subject.evaluator.instance
    else:
        compiled, instance = (
            driver.open_run(model).model if driver.is_run(model) else driver.load_model(model, findings),
            None,
        )
    output.findings(findings)
    text = backend.emit(compiled, instance)
    write_text(to, text)
    output.say(f"wrote {to}")
    output.document({"model": compiled.name, "emit": emit, "path": to, "class": class_name(compiled)})
