"""The frame of every command: `--quiet`, `--json`, an example in the help, and exit statuses instead of tracebacks.

Exit statuses: 0 done, 1 the input is wrong, 2 usage, 3 the computation failed, 70 a defect of gbspec, 130 interrupted,
141 the reader of the output has closed the pipe (what a shell says of other programs).
"""

from __future__ import annotations

import contextlib
import errno
import inspect
import os
import sys
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from gbspec.cli.flags import expand
from gbspec.cli.output import Output
from gbspec.diagnostics import ComputationError, Diagnostic, UserError, missing_package

OK, WRONG_INPUT, USAGE, FAILED, DEFECT, INTERRUPTED, UNREAD = 0, 1, 2, 3, 70, 130, 141

Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but results and errors.", metavar="")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document on standard output.", metavar="")]


class ExitWith(Exception):  # noqa: N818 - it is a way out, not an error
    """Ends a command with an exit status, after all messages have been written."""

    def __init__(self, status: int) -> None:
        self.status = status
        super().__init__(status)


@dataclass(frozen=True)
class Command:
    """A command as the application registers it: its name, the function typer calls, help and examples."""

    name: str
    call: Callable[..., None]
    help: str
    examples: tuple[str, ...]

    @property
    def epilog(self) -> str:
        """The examples, as the help shows them."""
        return "\n\n".join(("Example:" if len(self.examples) == 1 else "Examples:", *(f"  {e}" for e in self.examples)))


def command(name: str, *examples: str) -> Callable[[Callable[..., None]], Command]:
    """Makes a command from a function whose first parameter is its `Output`.

    Parameters annotated with an option dataclass are expanded into one flag per field (`gbspec.cli.flags`).
    """

    def decorate(function: Callable[..., None]) -> Command:
        parameters = list(inspect.signature(function, eval_str=True).parameters.values())[1:]
        shown, collect = expand(parameters)
        shown += [
            inspect.Parameter("quiet", inspect.Parameter.KEYWORD_ONLY, annotation=Quiet, default=False),
            inspect.Parameter("json", inspect.Parameter.KEYWORD_ONLY, annotation=Json, default=False),
        ]

        def call(**given: Any) -> None:
            output = Output(quiet=given.pop("quiet"), json=given.pop("json"))
            status = guarded(lambda: function(output, **collect(given)), output)
            if status:
                raise typer.Exit(status)

        call.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]  # what inspect documents
        call.__annotations__ = {p.name: p.annotation for p in shown}
        call.__name__ = function.__name__
        return Command(name, call, inspect.getdoc(function) or "", examples)

    return decorate


def guarded(work: Callable[[], None], output: Output) -> int:
    """Runs the work and returns its exit status; reports what went wrong, never with a traceback."""
    try:
        work()
    except ExitWith as leave:
        return leave.status
    except UserError as error:
        return _wrong_input(error.diagnostics, output)
    except ComputationError as error:
        return _failed(error, output)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has closed the pipe (`gbspec … | head`): no further output is possible, and what was to be said
        # (that a model is wrong) did not arrive, so that this is no success.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return UNREAD
    except MemoryError:
        return _failed(
            ComputationError("there is not enough memory", remedy="try fewer trajectories or a smaller network"), output
        )
    except OSError as error:
        known = file_trouble(error)
        return _wrong_input((known,), output) if known else _defect(error, output)
    except ImportError as error:
        lacking = missing_package(error)
        return _wrong_input((lacking,), output) if lacking else _defect(error, output)
    except Exception as error:  # the last line of defence, which keeps tracebacks from users
        return _defect(error, output)
    return OK


USAGE_CODES = frozenset(
    {"GB009", "GB750", "GB754", "GB807", "GB810", "GB812", "GB814", "GB850", "GB862", "GB875", "GB881"}
)
"""Codes of diagnostics about the command line, which is wrong whatever the files, tables and runs contain.

This is the rule for wrong names: one that no file could make right (of an option, a choice, a code, a form, an output's
format) is wrong usage; one that a file could have (of a model, a state, a constant, a trajectory) is wrong input.
"""


def _wrong_input(diagnostics: tuple[Diagnostic, ...], output: Output) -> int:
    from gbspec.diagnostics import to_json

    output.findings(diagnostics)
    output.document({"diagnostics": [to_json(d) for d in diagnostics]})
    return USAGE if any(d.code in USAGE_CODES for d in diagnostics) else WRONG_INPUT


def _failed(error: ComputationError, output: Output) -> int:
    print(f"error: {error.what}", file=sys.stderr)
    if error.where:
        print(f"   = where: {error.where}", file=sys.stderr)
    if error.remedy:
        print(f"   = try: {error.remedy}", file=sys.stderr)
    output.document({"error": {"what": error.what, "where": error.where, "remedy": error.remedy}})
    return FAILED


def _defect(error: BaseException, output: Output) -> int:
    said = f"{type(error).__name__}: {error}"
    print(f"defect: this is a defect of gbspec, not of your input: {said}", file=sys.stderr)
    details = "".join(traceback.format_exception(error))
    if os.environ.get("GBSPEC_TRACEBACK"):
        print(details, file=sys.stderr)
    else:
        print(f"   = note: details are in {_log(details)}", file=sys.stderr)
        print("   = help: GBSPEC_TRACEBACK=1 shows them here; please report them with the model", file=sys.stderr)
    output.document({"defect": said})
    return DEFECT


def _log(details: str) -> Path | str:
    """Writes the details to a new file and returns its path."""
    try:
        handle, name = tempfile.mkstemp(prefix="gbspec-defect-", suffix=".log")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(f"{' '.join(sys.argv)}\n\n{details}")
    except OSError:
        return "no file (none could be written)"
    return Path(name)


def file_trouble(error: OSError) -> Diagnostic | None:
    """The diagnostic for a file that cannot be used, or None if the error is of another kind."""
    name = error.filename if isinstance(error.filename, str | Path) else None
    shown = f"`{name}`" if name else "a file"
    match error.errno:
        case errno.ENOENT | errno.ENOTDIR:
            return Diagnostic("GB801", f"{shown} does not exist", None, help="check the path")
        case errno.EISDIR:
            return Diagnostic("GB802", f"{shown} is a directory; a file is expected", None, help="name a file in it")
        case errno.EACCES | errno.EPERM | errno.EROFS:
            return Diagnostic("GB805", f"{shown} cannot be used: permission denied", None, help="choose another path")
        case errno.ENOSPC | errno.EDQUOT | errno.ENAMETOOLONG | errno.ELOOP:
            reason = (error.strerror or "").lower()
            return Diagnostic("GB805", f"{shown} cannot be used: {reason}", None, help="choose another path")
        case errno.EINVAL if name and Path(name).exists() and not Path(name).is_file():
            help = "save its content to a file first"
            return Diagnostic("GB805", f"{shown} is a pipe or a device, not a file", None, help=help)
        case _:
            return None
