"""Requests to end (Ctrl-C, the end of a terminal, a batch system), so that an iteration is completed and kept."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
"""Signals by which a process is asked to end; not every system has all."""
GRACE = 2.0
"""Seconds in which a worker that was asked to end waits for the same request to reach its parent."""


class uninterrupted:  # noqa: N801 - a context manager, named like a phrase
    """A context that records requests to end, so that an iteration is completed; a second one is raised at once.

    Signals that the process ignores stay ignored: SIGHUP below `nohup`.
    """

    def __enter__(self) -> Callable[[], bool]:
        self._seen = 0
        self._before = {}
        if threading.current_thread() is threading.main_thread():
            for number in _signals():
                before = signal.getsignal(number)
                if before not in (signal.SIG_IGN, None):
                    self._before[number] = before
                    signal.signal(number, self._note)
        return lambda: self._seen > 0

    def _note(self, number: int, frame: object) -> None:
        self._seen += 1
        if self._seen > 1:
            raise KeyboardInterrupt

    def __exit__(self, *exception: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)


def _signals() -> list[signal.Signals]:
    return [getattr(signal, name) for name in NAMES if hasattr(signal, name)]


def start_tracker() -> None:
    """Starts the process that `multiprocessing` keeps for shared resources, where there is one, before signals wait.

    Begun later it would let them through. Windows has neither waiting signals nor such a process.
    """
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()


@contextmanager
def held_back() -> Iterator[None]:
    """A context in which requests to end wait; processes that are started in it begin with them waiting too."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _signals())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def serve_parent() -> None:
    """Makes this process, a worker, end with its parent, and leave Ctrl-C and the end of a terminal to it.

    A batch system asks all processes to end; the parent then asks its workers to finish their iterations.
    """
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for name in ("SIGINT", "SIGHUP", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _signals())


def serve_parent_unasked() -> None:
    """Like `serve_parent`, for a process that only passes messages: it ends when its parent tells it, or ends."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    serve_parent()


def _end_with_parent() -> None:
    """Ends this process at once when its parent has ended: another may already have begun the same member."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def end_unless(stopped: Callable[[], bool]) -> None:
    """Ends this worker, which was asked to end, unless its parent wants its result, as `stopped` soon says."""
    until = time.monotonic() + GRACE
    while time.monotonic() < until:
        if stopped():
            return
        time.sleep(0.05)
    os._exit(128 + signal.SIGTERM)
