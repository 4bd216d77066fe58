"""Fitting members one after the other, or in worker processes side by side."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from queue import Empty, Queue
from threading import Event
from typing import Any

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.ir.model import Model
from gbspec.runs import files
from gbspec.training.levenberg import use_threads
from gbspec.training.member import Interrupted, fit_member, uninterrupted
from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Update
from gbspec.training.summary import MemberResult

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def fit_members(
    model: Model,
    module: type[Any],
    trajectories: Trajectories,
    options: TrainOptions,
    directory: Path,
    progress: Progress,
    threads: int,
    results: dict[int, MemberResult],
) -> None:
    """Fits all members into `results`, as they are done (so that what is done survives a failure).

    Raises the first member's ComputationError after the others had their turn, if none could be fitted; else members
    that failed are missing from `results` and told as messages.
    """
    numbers = range(options.members)
    failures: list[ComputationError] = []
    if options.workers == 1 or options.members == 1:
        for member in numbers:
            try:
                place = files.member_directory(directory, member)
                results[member] = fit_member(model, module, trajectories, options, member, place, progress)
            except ComputationError as error:
                failures.append(error)
                progress.message(f"member {member} failed: {error.what}")
            except Interrupted as interruption:
                results[member] = interruption.result
                raise
    else:
        _fit_in_processes(model, trajectories, options, directory, progress, threads, results, failures)
    if failures and not results:
        raise failures[0]


def _fit_in_processes(
    model: Model,
    trajectories: Trajectories,
    options: TrainOptions,
    directory: Path,
    progress: Progress,
    threads: int,
    results: dict[int, MemberResult],
    failures: list[ComputationError],
) -> None:
    """A pool of spawned processes, each with its own torch and its own number of threads."""
    spawn = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    workers = min(options.workers, options.members)
    try:
        with spawn.Manager() as manager, ProcessPoolExecutor(workers, mp_context=spawn) as pool:
            queue: Queue[Any] = manager.Queue()
            stop = manager.Event()
            pending = {
                pool.submit(_work, model, trajectories, options, member, directory, threads, queue, stop): member
                for member in range(options.members)
            }
            _collect(pending, queue, stop, progress, results, failures)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _collect(
    pending: dict[Future[MemberResult], int],
    queue: Queue[Any],
    stop: Event,
    progress: Progress,
    results: dict[int, MemberResult],
    failures: list[ComputationError],
) -> None:
    """Waits for all members. On SIGINT every worker is told to stop after its iteration, and is waited for."""
    waiting = set(pending)
    with uninterrupted() as interrupted:
        while waiting:
            _drain(queue, progress)
            if interrupted() and not stop.is_set():
                stop.set()
                for future in pending:
                    future.cancel()
            for future in [f for f in waiting if f.done()]:
                waiting.discard(future)
                _take(future, pending[future], progress, results, failures)
        _drain(queue, progress)
        if interrupted():
            raise KeyboardInterrupt


def _take(
    future: Future[MemberResult],
    member: int,
    progress: Progress,
    results: dict[int, MemberResult],
    failures: list[ComputationError],
) -> None:
    """Files what a worker brought back."""
    if future.cancelled():
        return
    try:
        results[member] = future.result()
    except ComputationError as error:
        failures.append(error)
        progress.message(f"member {member} failed: {error.what}")
    except BrokenProcessPool:
        what = f"the process that fitted member {member} was killed (perhaps for lack of memory)"
        failures.append(ComputationError(what, remedy="use fewer `--workers`; `--resume` continues the run"))
        progress.message(what)


def _drain(queue: Queue[Any], progress: Progress) -> None:
    try:
        item = queue.get(timeout=0.2)
        while True:
            if isinstance(item, Update):
                progress.update(item)
            else:
                progress.message(str(item))
            item = queue.get_nowait()
    except Empty:
        return


class _Sender:
    """Progress that goes to the parent's queue."""

    def __init__(self, queue: Queue[Any]) -> None:
        self.queue = queue

    def update(self, update: Update) -> None:
        self.queue.put(update)

    def message(self, text: str) -> None:
        self.queue.put(text)


def _work(
    model: Model,
    trajectories: Trajectories,
    options: TrainOptions,
    member: int,
    directory: Path,
    threads: int,
    queue: Queue[Any],
    stop: Event,
) -> MemberResult:
    """One member, in a worker. An interruption comes back as an unfinished result: the weights are written."""
    use_threads(threads)
    place = files.member_directory(directory, member)
    try:
        return fit_member(model, load_module(model), trajectories, options, member, place, _Sender(queue), stop.is_set)
    except Interrupted as interruption:
        return interruption.result
