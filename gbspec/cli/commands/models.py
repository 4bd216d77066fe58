"""`gbspec models`: the models that come with gbspec."""

from __future__ import annotations

from gbspec.cli.frame import command
from gbspec.cli.output import Output


@command("models", "gbspec models")
def run(output: Output) -> None:
    """List the bundled models, each with its title; every command that takes a model takes their names."""
    from gbspec.operations import models
    from gbspec.report import listing

    found = models.bundled()
    output.document({"models": found})
    output.result(listing([(item.name, item.title) for item in found]))
    output.say("next: gbspec new my_model --from NAME      (a copy to change)")
