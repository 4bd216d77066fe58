"""`gbspec new NAME`: a commented model to start from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output
from gbspec.diagnostics import Diagnostic, UserError
from gbspec.files import write_text

STARTER = """\
model {name} "A batch culture: growth rate unknown, yield learned"

# States, each with a plausible range and a description.
state X in [0, 20] "biomass, g/L"
state S in [0, 50] "substrate, g/L"

# An unknown constant, with its starting value and its bounds.
learn Y = 0.4 in [0.05, 1] "yield, g biomass per g substrate"

# An unknown function of the substrate, learned as a small neural network.
unknown mu(S) by mlp(16, 16) "specific growth rate, 1/h"

# What is known: a process that converts substrate to biomass, and the balances that follow from it.
process growth: 1/Y*S -> X rate mu*X
X' = net(X)
S' = net(S)

# The columns of the data.
observe X
observe S

# A truth for experiments (`gbspec simulate` uses it to simulate data; training does not). Delete it for real data.
truth Y = 0.5
truth mu(S) = 0.6*S/(2 + S)
initial X = 0.2
initial S = 10
"""


@command("new", "gbspec new my_model")
def run(
    output: Output,
    name: Annotated[str, typer.Argument(help="The model's name; the file is NAME.gb.", metavar="NAME")],
) -> None:
    """Write a small commented model to start from, `NAME.gb`, in the current folder (or at the path given)."""
    path = Path(name) if name.endswith(".gb") else Path(f"{name}.gb")
    if not path.stem.isidentifier():
        help = f"use letters, digits and underscores, such as `{_suggested(path.stem)}`"
        raise UserError([Diagnostic("GB807", f"`{path.stem}` cannot be the name of a model", None, help=help)])
    if path.exists():
        raise UserError(
            [Diagnostic("GB806", f"`{path}` already exists", None, help="choose another name or remove it")]
        )
    write_text(path, STARTER.format(name=path.stem))
    output.document({"model": path.stem, "path": str(path)})
    output.say(f"wrote {path}\nnext: gbspec check {path}\n      gbspec simulate {path} -o {path.stem}.csv --span 12")


def _suggested(name: str) -> str:
    kept = "".join(c if c.isalnum() or c == "_" else "_" for c in name).strip("_")
    return kept if kept.isidentifier() else f"model_{kept}".rstrip("_")
