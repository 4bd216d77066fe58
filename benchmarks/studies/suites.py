"""What the studies of outside suites share: the command line, and the table of all cases."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, TypeVar


class Outcome(Protocol):
    """The end of a case, what was said about it, and its numbers as cells of the page."""

    @property
    def case(self) -> str:
        """Its name."""

    @property
    def end(self) -> str:
        """`passed`, `wrong`, `refused` or `failed`."""

    @property
    def said(self) -> tuple[str, ...]:
        """The reasons of a refusal."""

    def cells(self) -> tuple[str, ...]:
        """Its numbers."""


AnyOutcome = TypeVar("AnyOutcome", bound=Outcome)


def table(outcomes: Sequence[Outcome], *columns: str) -> list[str]:
    """The rows of all cases; `columns` are the names of the numbers."""
    return [
        f"| case | outcome | {' | '.join(columns)} |",
        f"|---|---|{'---:|' * len(columns)}",
        *(
            f"| {one.case} | {one.end}{': ' * bool(one.said)}{'; '.join(one.said)} | {' | '.join(one.cells())} |"
            for one in outcomes
        ),
    ]


def main(
    description: str | None,
    pattern: str,
    judged: Callable[[Path], AnyOutcome],
    page: Callable[[list[AnyOutcome]], str],
) -> None:
    """Judges every folder of a suite that fits a pattern; prints the outcomes, and writes the page."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("suite", type=Path)
    parser.add_argument("-o", dest="out", type=Path)
    given = parser.parse_args()
    outcomes = [judged(folder) for folder in sorted(given.suite.glob(pattern)) if folder.is_dir()]
    if given.out is not None:
        given.out.write_text(page(outcomes), encoding="utf-8")
    for one in outcomes:
        print(one.case, one.end, *one.cells(), *one.said)
