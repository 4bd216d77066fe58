"""`gbspec compile MODEL -o FILE`: the model in another form."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output

Form = Literal["module", "ir"]
"""The names of `gbspec.backends.registry.BACKENDS`, which is not imported to show the help."""


@command(
    "compile",
    "gbspec compile urp_gb2.gb -o urp_gb2.py",
    "gbspec compile urp_gb2.gb --emit ir -o urp_gb2.ir",
)
def run(
    output: Output,
    model: Annotated[str, typer.Argument(help="A model file (.gb).", metavar="MODEL")],
    to: Annotated[str, typer.Option("--output", "-o", help="The file to write.", metavar="FILE")],
    emit: Annotated[
        Form, typer.Option("--emit", help="module: a Python module; ir: what the compiler understood, as text.")
    ] = "module",
) -> None:
    """Compile a model to a standalone Python module (torch to run it, casadi to analyse it, gbspec for neither)."""
    from gbspec import driver
    from gbspec.backends.registry import BACKENDS
    from gbspec.diagnostics import Findings
    from gbspec.files import write_text

    findings = Findings()
    compiled = driver.load_model(model, findings)
    output.findings(findings)
    text = BACKENDS[emit].emit(compiled)
    write_text(to, text)
    output.say(f"wrote {to}")
    output.document({"model": compiled.name, "emit": emit, "path": to, "class": compiled.class_name})
