"""The progress of training on standard error: stage, loss, time left, and the current values of the constants."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from gbspec.cli.output import Output
from gbspec.report import number
from gbspec.training import Progress, Silent, Update

if TYPE_CHECKING:
    from types import TracebackType

    from rich.console import Console
    from rich.table import Table

INTERVAL = 5.0
"""Seconds between lines if standard error is not a terminal."""


@contextmanager
def shown(output: Output) -> Iterator[Progress]:
    """A progress display: a live one on a terminal, lines elsewhere, none with `--quiet`."""
    console = output.console()
    if output.quiet:
        yield Silent()
    elif console.is_terminal:
        with _Live(console) as live:
            yield live
    else:
        yield _Lines(output)


def line(update: Update) -> str:
    """The text of one iteration."""
    parts = [f"{update.stage} {update.iteration}/{update.total}", f"loss {number(update.loss)}"]
    parts += [f"{name} {number(value, 5)}" for name, value in update.constants.items()]
    if update.remark:
        parts.append(update.remark)
    if update.seconds_left is not None:
        parts.append(f"{clock(update.seconds_left)} left")
    return f"[{update.member}] " + ", ".join(parts)


def clock(seconds: float) -> str:
    """A duration as text: `40 s`, `3 min 20 s`, `2 h 05 min`."""
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    return (
        f"{whole // 60} min {whole % 60:02d} s" if whole < 3600 else f"{whole // 3600} h {whole % 3600 // 60:02d} min"
    )


class _Lines:
    """A line at each change of stage, and one every few seconds."""

    def __init__(self, output: Output) -> None:
        self.output = output
        self.last: dict[int, tuple[str, float]] = {}

    def update(self, update: Update) -> None:
        now = time.monotonic()
        stage, then = self.last.get(update.member, ("", 0.0))
        if update.stage != stage or now - then >= INTERVAL:
            self.last[update.member] = (update.stage, now)
            self.output.say(line(update))

    def message(self, text: str) -> None:
        self.output.say(text)


class _Live:
    """One row per member, redrawn in place; messages scroll above."""

    def __init__(self, console: Console) -> None:
        from rich.live import Live

        self.console = console
        self.latest: dict[int, Update] = {}
        self.live = Live(get_renderable=self.render, console=console, refresh_per_second=4, transient=True)

    def __enter__(self) -> _Live:
        self.live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.live.__exit__(kind, error, trace)

    def render(self) -> Table:
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        names = list(dict.fromkeys(name for update in self.latest.values() for name in update.constants))
        table = Table(box=None, padding=(0, 1), header_style="dim")
        for heading in ("member", "stage", "", "iteration", "loss", *names, "left"):
            table.add_column(heading, no_wrap=True, justify="left" if heading in ("stage", "") else "right")
        for member, update in sorted(self.latest.items()):
            bar = ProgressBar(total=max(update.total, 1), completed=update.iteration, width=24)
            left = "" if update.seconds_left is None else clock(update.seconds_left)
            constants = [number(update.constants.get(name), 5) for name in names]
            iteration = f"{update.iteration}/{update.total}"
            table.add_row(str(member), update.stage, bar, iteration, number(update.loss), *constants, left)
        return table

    def update(self, update: Update) -> None:
        self.latest[update.member] = update

    def message(self, text: str) -> None:
        self.console.print(text, style="dim")
