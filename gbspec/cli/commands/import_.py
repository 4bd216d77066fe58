"""`gbspec import FILE -o DIR`: a model of another format as a `.gb` file."""

from __future__ import annotations

from typing import Annotated

import typer

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("import", "gbspec import my_pathway.xml -o my_pathway", "gbspec import my_pathway.xml -o my_pathway --json")
def run(
    output: Output,
    source: Annotated[str, typer.Argument(help="SBML (.xml, .sbml) or a PEtab problem (.yaml).", metavar="FILE")],
    to: Annotated[str, typer.Option("--output", "-o", help="The folder for the model.", metavar="DIR")],
) -> None:
    """Import a model of another format: a readable `.gb` file, and a list of what could not be carried over.

    A model that the language cannot express faithfully is refused, with all reasons; then nothing is written.
    """
    from gbspec.operations import importing

    made = importing.import_file(source, to)
    output.document(made.to_json())
    for one in made.left_out:
        output.say(f"left out: {one.element}{f' (line {one.line})' if one.line else ''}: {one.reason}")
    output.say(f"wrote {made.model}")
    if made.data is not None:
        options = "".join(f" --{name} {value}" for name, value in made.options.items())
        output.say(f"wrote {made.data}; `gbspec train {made.model} {made.data} -o RUN{options}` fits it")
