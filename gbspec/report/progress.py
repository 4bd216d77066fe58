"""The progress of training on a terminal, in lines or in a notebook: stage, loss, constants, the most time left.

The time left is what all iterations that the stages may take would need at the present pace. Most stages end long
before, when they have converged, so that it is shown as an upper limit.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Protocol

from gbspec.report.text import number
from gbspec.training import Progress, Silent, Update

if TYPE_CHECKING:
    from types import TracebackType

    from rich.console import Console
    from rich.table import Table

INTERVAL = 5.0
"""Seconds between lines if standard error is not a terminal."""
REDRAWN = 0.5
"""Seconds between two drawings in a notebook."""
KEPT = 5
"""The messages that a notebook shows, the last ones."""


def line(update: Update) -> str:
    """The text of one iteration."""
    parts = [f"{update.stage} {update.iteration}/{update.total}", f"loss {number(update.loss)}"]
    parts += [f"{name} {number(value, 5)}" for name, value in update.constants.items()]
    if update.remark:
        parts.append(update.remark)
    if update.seconds_left is not None:
        parts.append(f"about {clock(update.seconds_left)} left")
    return f"[{update.member}] " + ", ".join(parts)


def clock(seconds: float) -> str:
    """A duration as text: `40 s`, `3 min 20 s`, `2 h 05 min`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    return (
        f"{whole // 60} min {whole % 60:02d} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    )


class Lines:
    """A line at each change of stage, and one every few seconds."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self.last: dict[int, tuple[str, float]] = {}

    def update(self, update: Update) -> None:
        """Writes a line if the stage is another, or the last line some seconds old."""
        now = time.monotonic()
        stage, then = self.last.get(update.member, ("", 0.0))
        if update.stage != stage or now - then >= INTERVAL:
            self.last[update.member] = (update.stage, now)
            self.say(line(update))

    def message(self, text: str) -> None:
        """Writes a remark."""
        self.say(text)


class _Rows:
    """The latest iteration of each member."""

    def __init__(self) -> None:
        self.latest: dict[int, Update] = {}
        self.messages: list[str] = []

    def update(self, update: Update) -> None:
        """Receives a completed iteration."""
        self.latest[update.member] = update

    def header(self) -> list[str]:
        """The headings of the columns of `rows`; the constants are those of the members so far."""
        return ["member", "stage", "iteration", "loss", *self._names(), "left, about"]

    def rows(self) -> list[list[str]]:
        """A row of texts for each member."""
        found = []
        for member, update in sorted(self.latest.items()):
            left = "" if update.seconds_left is None else clock(update.seconds_left)
            constants = [number(update.constants.get(name), 5) for name in self._names()]
            iteration = f"{update.iteration}/{update.total}"
            found.append([str(member), update.stage, iteration, number(update.loss), *constants, left])
        return found

    def _names(self) -> list[str]:
        return list(dict.fromkeys(name for update in self.latest.values() for name in update.constants))


class Live(_Rows):
    """One row per member on a terminal, redrawn in place; messages scroll above."""

    def __init__(self, console: Console) -> None:
        from rich.live import Live as Drawn

        super().__init__()
        self.console = console
        self.live = Drawn(get_renderable=self.render, console=console, refresh_per_second=4, transient=True)

    def __enter__(self) -> Live:
        self.live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.live.__exit__(kind, error, trace)

    def render(self) -> Table:
        """The table: a bar beside the stage shows its iterations, of which it seldom needs all."""
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        table = Table(box=None, padding=(0, 1), header_style="dim")
        for i, heading in enumerate([*self.header()[:2], "", *self.header()[2:]]):
            table.add_column(heading, no_wrap=True, justify="left" if i in (1, 2) else "right")
        for update, row in zip((u for _, u in sorted(self.latest.items())), self.rows(), strict=True):
            bar = ProgressBar(total=max(update.total, 1), completed=update.iteration, width=24)
            table.add_row(*row[:2], bar, *row[2:])
        return table

    def message(self, text: str) -> None:
        """Shows a remark above the table."""
        self.console.print(text, style="dim")


class Notebook(_Rows):
    """One row per member in a cell of a notebook, redrawn in place at most twice a second; the last messages below."""

    def __init__(self, display: Callable[..., Handle]) -> None:
        super().__init__()
        self.drawn, self.handle = 0.0, display(self, display_id=True)

    def update(self, update: Update) -> None:
        """Receives a completed iteration."""
        super().update(update)
        self.draw()

    def message(self, text: str) -> None:
        """Receives a remark."""
        self.messages.append(text)
        self.draw(now=True)

    def draw(self, *, now: bool = False) -> None:
        """Redraws the cell's output."""
        moment = time.monotonic()
        if now or moment - self.drawn >= REDRAWN:
            self.drawn = moment
            self.handle.update(self)

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{escape(name)}</th>" for name in self.header())
        body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in self.rows())
        lines = "".join(f"<p>{escape(text)}</p>" for text in self.messages[-KEPT:])
        return (f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>" if body else "") + lines

    def __repr__(self) -> str:
        return "\n".join([*(line(update) for _, update in sorted(self.latest.items())), *self.messages[-KEPT:]])


class Handle(Protocol):
    """What IPython's `display` returns."""

    def update(self, shown: object) -> None:
        """Replaces what is shown."""


@contextmanager
def progress_of(given: Progress | bool | None) -> Iterator[Progress]:
    """What shows the progress of a call: what was given; else a table in a notebook, and nothing elsewhere.

    With True it is shown elsewhere too, on standard error: a table on a terminal, else lines. False shows nothing.
    """
    display = _notebook()
    if given is not None and not isinstance(given, bool):
        yield given
    elif given is False or (given is None and display is None):
        yield Silent()
    elif display is not None:
        shown = Notebook(display)
        try:
            yield shown
        finally:
            shown.draw(now=True)
    else:
        from rich.console import Console

        console = Console(stderr=True, highlight=False)
        with progress_on(console, lambda text: print(text, file=sys.stderr, flush=True)) as live:
            yield live


@contextmanager
def progress_on(console: Console, say: Callable[[str], None]) -> Iterator[Progress]:
    """A live display if the console is a terminal, else lines that `say` writes."""
    if not console.is_terminal:
        yield Lines(say)
        return
    with Live(console) as live:
        yield live


def _notebook() -> Callable[..., Handle] | None:
    """The `display` of IPython where a notebook runs; None elsewhere, also in IPython on a terminal."""
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    if shell is None or not hasattr(shell, "kernel"):
        return None
    found: Callable[..., Handle] = importlib.import_module("IPython.display").display
    return found
