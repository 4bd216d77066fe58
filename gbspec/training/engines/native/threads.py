"""Distribution of work over threads, and a persistent work space for each thread."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache

import numpy as np
from numpy.typing import NDArray


def shared_out(part: Callable[[int], None], count: int, threads: int) -> None:
    """Runs all parts on `threads` threads, including the calling one (if that slept, two woken threads would often
    share a core). The calls release the interpreter's lock, so that plain threads run in parallel."""
    left = iter(range(count))

    def work() -> None:
        for i in left:
            part(i)

    helpers = [_pool(threads - 1, os.getpid()).submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        # Also after an exception here: the other threads still read arrays of the caller.
        for _ in left:
            pass
        wait(helpers)
    for helper in helpers:
        helper.result()


@cache
def _pool(threads: int, process: int) -> ThreadPoolExecutor:
    """A pool of threads, recreated in a forked process."""
    return ThreadPoolExecutor(threads, thread_name_prefix="gbspec-kernel")


_spaces = threading.local()


def workspace(size: int) -> NDArray[np.uint8]:
    """The work space of the calling thread, kept between calls."""
    space: NDArray[np.uint8] | None = getattr(_spaces, "bytes", None)
    if space is None or len(space) < size:
        space = _spaces.bytes = np.empty(size, dtype=np.uint8)
    return space


def release() -> None:
    """Frees the work space of the calling thread."""
    vars(_spaces).clear()
