"""What is said when training is interrupted: what can be used, and the command that continues."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gbspec.cli.frame import INTERRUPTED, ExitWith


@contextmanager
def continued(directory: Path) -> Iterator[None]:
    """A context in which an interruption (Ctrl-C, SIGTERM, SIGHUP) ends with one line about the directory."""
    try:
        yield
    except KeyboardInterrupt:
        if directory.exists():
            print(f"interrupted: {usable(directory)}; to continue: {command(sys.argv)}", file=sys.stderr)
        else:  # there is nothing that `--resume` could continue
            print("interrupted: nothing was written yet; the same command begins again", file=sys.stderr)
        raise ExitWith(INTERRUPTED) from None


def usable(directory: Path) -> str:
    """What can be used of a run, or of the runs of a sweep."""
    from gbspec.runs import member_numbers

    runs = [directory] if (directory / "fit.json").is_file() else sorted(directory.glob("*/fit.json"))
    if runs in ([], [directory]):
        numbers = member_numbers(directory)
        if not numbers:
            return f"`{directory}` has no weights yet"
        names = ", ".join(map(str, numbers))
        return f"`{directory}` can be used as it is (weights of member{'s' if len(numbers) > 1 else ''} {names})"
    there = sum(bool(member_numbers(path.parent)) for path in runs)
    return f"{there} of {len(runs)} runs in `{directory}` can be used as they are"


def command(words: list[str]) -> str:
    """The command that continues, for a shell."""
    given = words[1:]
    return shlex.join(["gbspec", *given, *([] if "--resume" in given else ["--resume"])])
