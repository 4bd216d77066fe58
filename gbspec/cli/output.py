"""The output of commands: results go to standard output, everything else to standard error."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import Diagnostic
from gbspec.json_values import Json

if TYPE_CHECKING:
    from rich.console import Console


MOST_SHOWN = 250
"""The diagnostics that are written as text."""


def jsonable(value: object) -> Json:
    """The value in JSON types; arrays become lists, and non-finite numbers become null (JSON has no NaN)."""
    if value is None or isinstance(value, bool | str | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, Enum):
        return jsonable(value.value)
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # NumPy's arrays and scalars
        return jsonable(value.tolist())
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: jsonable(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Iterable):
        return [jsonable(item) for item in value]
    raise TypeError(f"{type(value).__name__} has no JSON form")


class Output:
    """Where a command writes. `quiet`: nothing but results and errors; `json`: results as one document."""

    def __init__(self, *, quiet: bool = False, json: bool = False) -> None:
        self.quiet, self.json = quiet, json
        self.answered = False

    def console(self) -> Console:
        """A rich console on standard error, silent with `--quiet`."""
        from rich.console import Console

        return Console(stderr=True, quiet=self.quiet, highlight=False)

    def say(self, text: str = "") -> None:
        """A message for the user, on standard error; omitted with `--quiet`."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def result(self, text: str) -> None:
        """The result as text, on standard output; omitted with `--json`."""
        if not self.json:
            print(text, flush=True)

    def summary(self, text: str) -> None:
        """A result that is omitted with `--quiet` (the exit status tells as much)."""
        if not self.quiet:
            self.result(text)

    def document(self, value: object) -> None:
        """The result as a single JSON document on standard output; nothing without `--json`."""
        if self.json and not self.answered:
            self.answered = True
            print(json.dumps(jsonable(value), indent=2, ensure_ascii=False, allow_nan=False), flush=True)

    @contextmanager
    def bar(self, word: str) -> Iterator[Callable[[int, int], None]]:
        """A progress bar on standard error if that is a terminal; yields a function of the counts done and in total."""
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        console = self.console()
        with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
            task = progress.add_task(word, total=None)
            yield lambda done, total: progress.update(task, completed=done, total=total)

    def findings(self, diagnostics: Iterable[Diagnostic], *, errors_only: bool = False) -> None:
        """Diagnostics with excerpts on standard error; with `errors_only` (or `--quiet`) only the errors."""
        from gbspec.diagnostics import Severity, render_text

        shown = [d for d in diagnostics if d.severity is Severity.ERROR or not (self.quiet or errors_only)]
        hidden = len(shown) - MOST_SHOWN
        if shown:
            color = sys.stderr.isatty() and not _no_color()
            print(render_text(shown[:MOST_SHOWN], color).rstrip("\n"), file=sys.stderr, flush=True)
        if hidden > 0:
            print(f"and {hidden:,} more, which `--json` lists", file=sys.stderr, flush=True)


def _no_color() -> bool:
    import os

    return bool(os.environ.get("NO_COLOR")) or os.environ.get("TERM") == "dumb"
