"""Work shared out among threads, and the work space that each of them keeps."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

import numpy as np
from numpy.typing import NDArray


def shared_out(part: Callable[[int], None], count: int, threads: int) -> None:
    """Does all parts on some threads. The one that asks is among them: if it slept, two that it wakes would often find
    themselves on one core. The calls hold no lock of the interpreter, so plain threads run side by side."""
    left = iter(range(count))

    def work() -> None:
        for i in left:
            part(i)

    helpers = [_pool(threads - 1, os.getpid()).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        # Whatever stopped this one: the others read arrays of the caller.
        for _ in left:
            pass
        wait(helpers)
    for helper in helpers:
        helper.result()


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """Threads that wait for work, made anew in a forked process."""
    return ThreadPoolExecutor(threads, thread_name_prefix="gbspec-kernel")


_spaces = threading.local()


def workspace(size: int) -> NDArray[np.uint8]:
    """The work space of the thread that asks, kept between calls."""
    space: NDArray[np.uint8] | None = getattr(_spaces, "bytes", None)
    if space is None or len(space) < size:
        space = _spaces.bytes = np.empty(size, dtype=np.uint8)
    return space


def release() -> None:
    """Gives back the work space of the thread that asks."""
    vars(_spaces).clear()
