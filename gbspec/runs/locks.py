"""One process at a time writes to a run directory: a lock that the system releases when the process ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.runs.files import LOCK

GLANCE = 0.1
"""Seconds in which a lock that only another look at it held is free again."""
PATIENCE = 3.0
"""Seconds to wait for a lock: a process that has lost its parent needs a moment to end."""


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Holds the lock of a directory, which is created. The same thread may enter again.

    Raises UserError (GB864) if another process, or another thread, holds it.
    """
    from filelock import FileLock, Timeout

    directory.mkdir(parents=True, exist_ok=True)
    lock = FileLock(str(directory.resolve() / LOCK), timeout=PATIENCE, is_singleton=True)
    try:
        lock.acquire()
    except Timeout:
        message = f"another process is writing to `{directory}`"
        help_text = "wait until it has ended, or end it; name another directory with `-o` for a second run"
        raise UserError([Diagnostic("GB864", message, None, help=help_text)]) from None
    try:
        yield
    finally:
        lock.release()


def held_elsewhere(directory: Path) -> bool:
    """Whether another process, or another thread, writes to a run now."""
    from filelock import FileLock, Timeout

    path = directory.resolve() / LOCK
    if not path.is_file():
        return False
    lock = FileLock(str(path), timeout=PATIENCE, is_singleton=True)
    try:
        # Another process that looks as this one does holds it for a moment too.
        with lock.acquire(timeout=GLANCE, poll_interval=GLANCE / 10):
            return False
    except Timeout:
        return True
    except OSError:  # a run that this process may not write to
        return False
