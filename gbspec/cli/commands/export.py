"""`gbspec export RUN|MODEL -o FILE --as FORM`: a model for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.flags import choice
from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Settings, settings
from gbspec.operations import exporting

FORMS = exporting.forms()


@command(
    "export",
    "gbspec export my_run -o my_library --as c",
    "gbspec export my_run -o my_model.fmu --as fmu3",
    "gbspec export my_run -o phi.onnx --as onnx --part phi --precision float32",
    "gbspec export model.gb -o problem --as petab --data table.csv",
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A run, or a model with a truth.", metavar="RUN|MODEL")],
    to: Annotated[str, typer.Option("--output", "-o", help="The file or folder to write.", metavar="FILE")],
    as_: Annotated[
        str,
        typer.Option(
            "--as",
            parser=choice(tuple(FORMS)),
            metavar="FORM",
            help="; ".join(f"{name}: {said}" for name, said in FORMS.items()) + ".",
        ),
    ],
    verify: Annotated[
        bool, typer.Option("--verify/--no-verify", help="Compare it with the generated module before it is written.")
    ] = True,
    precision: Annotated[
        str,
        typer.Option("--precision", parser=choice(("float64", "float32")), metavar="TYPE", help="Of ONNX graphs."),
    ] = "float64",
    part: Annotated[
        str | None,
        typer.Option("--part", help="One ONNX graph alone: rhs, observe, step, or a learned function.", metavar="NAME"),
    ] = None,
    data: Annotated[
        str | None, typer.Option("--data", help="The table of measurements of a PEtab problem.", metavar="FILE")
    ] = None,
    set_values: Settings = None,
    member: Annotated[
        int | None, typer.Option("--member", help="A member of the run; default: the best.", metavar="K")
    ] = None,
) -> None:
    """Export a learned model for other programs; networks are inside, gbspec and Python are not needed."""
    from gbspec.diagnostics import Findings
    from gbspec.exports import ExportOptions
    from gbspec.frames import counted
    from gbspec.operations import models, tables

    findings = Findings()
    subject = models.subject(source, settings(set_values), findings, member)
    table = None if data is None else tables.read_for_subject(subject, data, findings)
    options = ExportOptions(verify, "float32" if precision == "float32" else "float64", part, table)
    made = exporting.export(subject, to, as_, options, findings, source)
    output.findings(findings)
    worst = max(made.checked.values(), default=None)
    checked = "" if worst is None else f"; it agrees with the generated module to {worst:.0e}"
    place = f"the folder {to} ({counted(len(made.files), 'file')})" if Path(to).is_dir() else to
    output.say(f"wrote {place}: {made.size / 1000:.0f} kB{checked}")
    output.document(made)
