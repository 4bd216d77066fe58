"""`gbspec new NAME`: a commented model to start from, or a copy of another one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.files import write_text

STARTER = """\
model {name} "Stirred tank: the rate of its reaction is to be learned"

# A flows into a stirred tank of constant volume and reacts to B; the same flow takes both out. That much is known, and
# stands in the balances. How fast A reacts, and how much B it gives, is not known, and is learned from measurements.

# The column of times in the data, and its unit. Units are checked where they are given; to do without, delete `: ...`.
time t : min

# States change over time. A range is what is plausible; simulated trajectories start anywhere in these ranges.
state A : mol/L in [0, 2] "concentration of A"
state B : mol/L in [0, 2] "concentration of B"

# A condition is set for each trajectory by whoever does the experiment, and is a column of the data.
condition D : 1/min in [0.2, 1] "flow through the tank, divided by its volume"

# A known constant, and one to be learned, with its starting value and its bounds.
const A_feed : mol/L = 2 "concentration of A in the feed"
learn y = 0.5 in [0.1, 1] "B formed from A, mol/mol"

# A function to be learned: a small neural network of A, which cannot be negative.
unknown r(A) : mol/L/min >= 0 by mlp(16, 16) "rate of the reaction"

# A process says what becomes what, and how fast; `net(A)` is the sum of all that processes do to A.
process reaction: A -> y*B rate r
A' = net(A) + D*(A_feed - A)
B' = net(B) - D*B

# What is measured: the other columns of the data. A cell is empty where nothing was measured.
observe A
observe B

# A truth to experiment with: `gbspec simulate` makes data with it, and training never sees it. Delete it for real data.
truth y = 0.8
truth r(A) = 0.6*A/(0.5 + A)
"""


@command("new", "gbspec new my_model", "gbspec new my_tank --from fed_batch")
def run(
    output: Output,
    name: Annotated[str, typer.Argument(help="The model's name; the file is NAME.gb.", metavar="NAME")],
    origin: Annotated[
        str | None,
        typer.Option(
            "--from", help="Copy this model: a bundled one, which `gbspec models` lists, or a file.", metavar="MODEL"
        ),
    ] = None,
) -> None:
    """Write a commented model to start from, `NAME.gb`, in the current folder (or at the path given)."""
    path = Path(name) if name.endswith(".gb") else Path(f"{name}.gb")
    if not path.stem.isidentifier():
        help = f"use letters, digits and underscores, such as `{_suggested(path.stem)}`"
        raise UserError([Diagnostic("GB807", f"`{path.stem}` cannot be the name of a model", None, help=help)])
    if path.exists():
        raise UserError(
            [Diagnostic("GB806", f"`{path}` already exists", None, help="choose another name or remove it")]
        )
    text, simulates = (STARTER.format(name=path.stem), True) if origin is None else _copy(origin, path.stem)
    write_text(path, text)
    output.document({"model": path.stem, "path": str(path), "from": origin})
    commands = [f"gbspec check {path}", f"gbspec train {path} my_data.csv -o {path.stem}_run"]
    if simulates:
        table = f"{path.stem}.csv"
        commands[1:] = [f"gbspec simulate {path} -o {table}", f"gbspec train {path} {table} -o {path.stem}_run"]
    output.say(f"wrote {path}\nnext: " + "\n      ".join(commands))


def _copy(origin: str, name: str) -> tuple[str, bool]:
    """The text of a model with another name, and whether data can be simulated with it."""
    from gbspec.operations import models

    return models.copied(origin, name)


def _suggested(name: str) -> str:
    kept = "".join(c if c.isalnum() or c == "_" else "_" for c in name).strip("_")
    return kept if kept.isidentifier() else f"model_{kept}".rstrip("_")
