"""Whether a command line is one that gbspec accepts, without running it."""

from __future__ import annotations

import importlib
import shlex
from typing import Any

import typer
from typer.testing import CliRunner

from gbspec.cli.app import COMMANDS
from gbspec.cli.frame import Command


def load(name: str) -> Command:
    """The command of that name."""
    made = importlib.import_module(COMMANDS[name]).run
    assert isinstance(made, Command)
    return made


def accepted(line: str) -> bool:
    """Whether the command's own parser takes the line (`gbspec NAME ARGUMENTS`)."""
    program, name, *arguments = shlex.split(line, comments=True)
    assert program == "gbspec"
    made, called = load(name), []

    def record(**given: Any) -> None:
        called.append(given)

    record.__signature__ = made.call.__signature__  # type: ignore[attr-defined]  # what inspect documents
    record.__annotations__ = made.call.__annotations__
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command(name)(record)
    result = CliRunner().invoke(app, arguments)
    return result.exit_code == 0 and len(called) == 1
