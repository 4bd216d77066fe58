"""The application: the table of commands, each imported only when it is called, and the entry point."""

from __future__ import annotations

import atexit
import codecs
import gc
import importlib
import io
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from gbspec.version import __version__

COMMANDS = {
    "new": "gbspec.cli.commands.new",
    "models": "gbspec.cli.commands.models",
    "check": "gbspec.cli.commands.check",
    "fmt": "gbspec.cli.commands.fmt",
    "compile": "gbspec.cli.commands.compile",
    "export": "gbspec.cli.commands.export",
    "import": "gbspec.cli.commands.import_",
    "explain": "gbspec.cli.commands.explain",
    "lsp": "gbspec.cli.commands.lsp",
    "simulate": "gbspec.cli.commands.simulate",
    "train": "gbspec.cli.commands.train",
    "sweep": "gbspec.cli.commands.sweep",
    "validate": "gbspec.cli.commands.validate",
    "predict": "gbspec.cli.commands.predict",
    "eigen": "gbspec.cli.commands.eigen",
    "bifurcate": "gbspec.cli.commands.bifurcate",
    "evaluate": "gbspec.cli.commands.evaluate",
    "profile": "gbspec.cli.commands.profile",
    "compare": "gbspec.cli.commands.compare",
    "plot": "gbspec.cli.commands.plot",
    "report": "gbspec.cli.commands.report",
    "crossvalidate": "gbspec.cli.commands.crossvalidate",
    "study": "gbspec.cli.commands.study",
    "demo": "gbspec.cli.commands.demo",
    "completion": "gbspec.cli.commands.completion",
}
"""Name of each command and the module whose `run` it is, in the order in which the help lists them."""

HELP = """A compiler for gray-box dynamical models.

A `.gb` file states which balances are known and which functions are unknown. gbspec checks it, compiles it to a
Python module, learns the unknown functions and constants from data, and shows the results.

Start with `gbspec demo`, or with `gbspec new my_model`.
"""


def without_types(parameters: list[Any]) -> list[Any]:
    """The parameters, of which the help shows no type of Python: `--help` and the arguments have no other word."""
    for parameter in parameters:
        if parameter.metavar is None or parameter.param_type_name == "argument":
            parameter.display_type_rich = lambda ctx: None
    return parameters


class _Command(TyperCommand):
    def get_params(self, ctx: Any) -> list[Any]:
        return without_types(super().get_params(ctx))


class _Group(TyperGroup):
    def get_params(self, ctx: Any) -> list[Any]:
        return without_types(super().get_params(ctx))


def build(names: Sequence[str] = tuple(COMMANDS)) -> typer.Typer:
    """The typer application with the commands of those names."""
    app = typer.Typer(
        name="gbspec",
        cls=_Group,
        help=HELP,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    )

    @app.callback()
    def options(
        version: Annotated[
            bool, typer.Option("--version", help="Show the version.", is_eager=True, callback=_version)
        ] = False,
    ) -> None:
        """Options of gbspec itself."""

    options.__doc__ = HELP
    for name in names:
        command = importlib.import_module(COMMANDS[name]).run
        app.command(command.name, cls=_Command, help=command.help, epilog=command.epilog)(command.call)
    return app


def _version(wanted: bool) -> None:
    if wanted:
        print(f"gbspec {__version__}")
        raise typer.Exit


def needed(arguments: Sequence[str]) -> tuple[str, ...]:
    """The commands to import for these arguments: the one they name, or all if they name none (help, a mistake)."""
    first = next((argument for argument in arguments if not argument.startswith("-")), None)
    return (first,) if first in COMMANDS else tuple(COMMANDS)


def main(arguments: Sequence[str] | None = None) -> None:
    """The entry point of the `gbspec` command; exits by `SystemExit` with a status of `gbspec.cli.frame`."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    # Imports create hundreds of thousands of permanent objects. Collecting garbage less often, and not at all when the
    # process ends, saves a fifth of the time of `gbspec check` (benchmarks/check_time.py).
    gc.set_threshold(50_000, 20, 20)
    atexit.register(gc.freeze)
    _readable_elsewhere()
    try:
        build(needed(given))(args=given, prog_name="gbspec")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def _readable_elsewhere() -> None:
    """Output into files and pipes is UTF-8, as gbspec reads it; what a terminal cannot show is written as its number.

    Windows would choose an encoding of the country, which lacks most characters of a formula.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and codecs.lookup(stream.encoding).name != "utf-8":
            if stream.isatty():
                stream.reconfigure(errors="backslashreplace")
            else:
                stream.reconfigure(encoding="utf-8")
