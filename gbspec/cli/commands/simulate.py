"""`gbspec simulate MODEL|RUN -o DATA`: simulates measurements with a model's truth or with a trained model."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.cli.settings import Form, Settings, settings
from gbspec.data import SimulateOptions
from gbspec.frames import counted


@command(
    "simulate",
    "gbspec simulate urp_gb2 -o urp.csv --sampling gamma --channels own-clock --seed 1",
    "gbspec simulate my_drug.gb -o drug.csv --dose gut=80:120@0,12 --span 24 --dt 1",
    'gbspec simulate urp_gb2 -o urp.csv --initial x1=0.2:0.9 --condition Da=0.3 --reject "x2 > 4" --noise 0.02',
)
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="A model with a truth, or a run.", metavar="MODEL|RUN")],
    to: Annotated[str, typer.Option("--output", "-o", help="The table: .csv, .tsv or .parquet.", metavar="DATA")],
    options: SimulateOptions,
    like: Annotated[
        str | None, typer.Option("--like", help="Take times, inputs and doses from this table.", metavar="TABLE")
    ] = None,
    set_values: Settings = None,
    form: Form = "auto",
    member: Annotated[
        int | None, typer.Option("--member", help="A member of the run; default: the best.", metavar="K")
    ] = None,
) -> None:
    """Simulate a table of measurements with an adaptive integrator (relative tolerance 1e-10)."""
    from gbspec.data import write
    from gbspec.diagnostics import Findings
    from gbspec.operations import models, tables
    from gbspec.report import target

    findings = Findings()
    target(to)
    subject = models.subject(source, settings(set_values), findings, member)
    table = None if like is None else tables.read_data(like, subject.model, findings, require_channels=False, form=form)
    output.findings(findings)
    with output.bar("simulating") as advance:
        data = tables.simulate(subject, options, table, advance)
    write(to, data, subject.model)
    rejected = int(data.meta.get("rejected", 0)) + int(data.meta.get("failed", 0))
    again = f" ({rejected} drawn again)" if rejected else ""
    made = counted(len(data), "trajectory")
    output.say(f"wrote {to}: {made}{again}, {counted(data.measurements, 'measured value')}")
    beyond = tables.far_outside(data, subject.model)
    for line in beyond:
        output.say(f"note: {line}")
    output.document(
        {
            "path": to,
            "model": subject.model.name,
            "trajectories": len(data),
            "rows": data.rows,
            "values": data.measurements,
            "redrawn": rejected,
            "outside": beyond,
            "options": options,
        }
    )
