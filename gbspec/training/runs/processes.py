"""Workers that are processes on this machine."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing.managers import SyncManager
from queue import Queue
from threading import Event
from typing import Any

from gbspec.diagnostics import ComputationError
from gbspec.training.optimise import use_threads
from gbspec.training.progress import Update
from gbspec.training.runs.jobs import Job, Pending, Sender, Workers, fit
from gbspec.training.runs.member import Interrupted
from gbspec.training.runs.signals import end_unless, held_back, serve_parent, serve_parent_unasked, start_tracker
from gbspec.training.runs.summary import MemberResult

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@contextmanager
def processes(workers: int, threads: int) -> Iterator[Workers]:
    """A pool of spawned processes, each with its own torch and its own number of threads."""
    spawn = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        start_tracker()
        with _without_main(), ExitStack() as stack:
            manager = SyncManager(ctx=spawn)
            with held_back():
                manager.start(serve_parent_unasked)
            stack.callback(manager.shutdown)
            pool = stack.enter_context(ProcessPoolExecutor(workers, mp_context=spawn, initializer=serve_parent))
            yield _Processes(pool, manager.Queue(), manager.Event(), threads)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _without_main() -> Iterator[None]:
    """A context in which spawned processes do not run the main script, which might itself train."""
    main = sys.modules["__main__"]
    hidden: dict[str, object] = {name: vars(main).pop(name) for name in ["__file__", "__spec__"] if name in vars(main)}
    vars(main)["__spec__"] = None
    try:
        yield
    finally:
        vars(main).update(hidden)


class _Processes:
    def __init__(self, pool: ProcessPoolExecutor, messages: Queue[Update | str], stopped: Event, threads: int) -> None:
        self.pool, self.messages, self.stopped, self.threads = pool, messages, stopped, threads
        self.stopping = False

    def submit(self, job: Job) -> Pending:
        with held_back():
            return self.pool.submit(_work, job, self.threads, self.messages, self.stopped)

    def outcome(self, pending: Any, job: Job) -> MemberResult | None:
        try:
            result: MemberResult | None = pending.result()
        except BrokenProcessPool:
            if self.stopping:  # whoever asked this process to end asked its workers too
                return None
            what = f"the process that fitted {job.name} was killed (possibly because memory was exhausted)"
            raise ComputationError(what, remedy="use fewer `--workers`; `--resume` continues the run") from None
        return result

    def stop(self) -> None:
        self.stopping = True
        self.stopped.set()


def _work(job: Job, threads: int, messages: Queue[Update | str], stopped: Event) -> MemberResult | None:
    """Fits one member in a worker. After an interruption returns an unfinished result; the weights are written."""
    use_threads(threads)
    if stopped.is_set():
        return None
    try:
        return fit(job, Sender(messages.put), stopped.is_set)
    except Interrupted as interruption:
        end_unless(stopped.is_set)
        return interruption.result
