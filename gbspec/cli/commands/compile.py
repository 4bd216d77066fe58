"""`gbspec compile MODEL|RUN -o FILE`: the model in another form."""

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
    "gbspec compile urp_gb2.gb --solver dopri5 -o urp_gb2.py",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb), or a run directory.", metavar="MODEL")],
    to: Annotated[str, typer.Option("--output", "-o", help="The file to write.", metavar="FILE")],
    emit: Annotated[
        Form,
        typer.Option(
            "--emit",
            help="module: a Python module; ir: what the compiler understood, as text; latex: a page of typeset "
            "equations; c: right-hand side, Jacobian and step in C, with the numbers of a run or of the model's truth.",
        ),
    ] = "module",
    solver: Annotated[
        str | None,
        typer.Option(
            "--solver",
            help="The method whose step the module and the C code have; that of a run, else `rk4`.",
            metavar="NAME",
        ),
    ] = None,
) -> None:
    """Compile a model to a standalone Python module (torch to run it, casadi to analyse it, gbspec for neither)."""
    from gbspec import driver
    from gbspec.backends.module import class_name
    from gbspec.backends.registry import BACKENDS
    from gbspec.diagnostics import Findings
    from gbspec.files import write_text
    from gbspec.ir.methods import RK4, method_named

    findings = Findings()
    backend = BACKENDS[emit]
    chosen = None if solver is None else method_named(solver)
    if driver.is_run(model):
        trained = driver.open_run(model)
        method = chosen or trained.method
        compiled = trained.model
        instance = driver.learned(trained.stepped_by(method)).evaluator.instance if backend.numbers else None
    else:
        method = chosen or RK4
        compiled = driver.load_model(model, findings)
        instance = driver.reference(compiled, method=method).evaluator.instance if backend.numbers else None
    output.findings(findings)
    text = backend.emit(compiled, instance, method)
    write_text(to, text)
    output.say(f"wrote {to}")
    output.document({"model": compiled.name, "emit": emit, "path": to, "class": class_name(compiled)})
