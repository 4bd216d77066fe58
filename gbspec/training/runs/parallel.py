"""Fitting members: one after the other in this process, or side by side by an engine (processes, a cluster)."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, Queue
from threading import Event
from typing import Any, Protocol

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import ComputationError, UserError
from gbspec.ir.methods import METHODS
from gbspec.ir.model import Model
from gbspec.runs import files
from gbspec.training.optimise.normal_equations import use_threads
from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Update
from gbspec.training.runs.member import Interrupted, fit_member, uninterrupted
from gbspec.training.runs.summary import MemberResult

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


@dataclass(frozen=True, eq=False)
class Job:
    """One member to fit, with all that another process needs: `run` is the run directory, `number` tells jobs apart."""

    model: Model
    trajectories: Trajectories
    options: TrainOptions
    member: int
    run: Path
    number: int

    @property
    def name(self) -> str:
        """How the job is called to the user."""
        return f"member {self.member} of `{self.run.name}`"

    @property
    def place(self) -> Path:
        """Where the member's files are."""
        return files.member_directory(self.run, self.member)


Take = Callable[[Job, MemberResult | ComputationError], None]
"""Receives what became of a job, as soon as it is known."""


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def fit_jobs(jobs: Sequence[Job], options: TrainOptions, progress: Progress, take: Take) -> None:
    """Fits all jobs, by the workers, threads and scheduler that `options` asks for.

    Raises KeyboardInterrupt on SIGINT, after every member under way has written what it reached and was taken.
    """
    if options.scheduler is not None:
        from gbspec.training.runs.cluster import cluster

        with cluster(options.scheduler, options.threads or 1) as engine:
            _collect(engine, jobs, progress, take)
        return
    default = cores() if options.device == "cpu" else 1
    workers = min(options.workers or default, len(jobs))
    threads = options.threads or max(1, cores() // max(workers, 1))
    if workers > 1:
        with _processes(workers, threads) as engine:
            _collect(engine, jobs, progress, take)
        return
    use_threads(threads)
    for job in jobs:
        try:
            take(job, fit(job, progress))
        except ComputationError as error:
            take(job, error)
        except Interrupted as interruption:
            take(job, interruption.result)
            raise


def fit(
    job: Job, progress: Progress, stop: Callable[[], bool] = lambda: False, place: Path | None = None
) -> MemberResult:
    """Fits one member in this process, by default where its run wants the files; raises like `fit_member`."""
    module = load_module(job.model, METHODS[job.options.solver])
    numbered = _Numbered(progress, job.number)
    return fit_member(job.model, module, job.trajectories, job.options, job.member, place or job.place, numbered, stop)


class _Numbered:
    """Progress that calls members by the numbers of their jobs, which differ where a sweep has several runs."""

    def __init__(self, progress: Progress, number: int) -> None:
        self.progress, self.number = progress, number

    def update(self, update: Update) -> None:
        self.progress.update(replace(update, member=self.number))

    def message(self, text: str) -> None:
        self.progress.message(text)


# -------------------------------------------------------------------------------------------------- engines
class Pending(Protocol):
    """A job that an engine has been given."""

    def done(self) -> bool:
        """Whether nothing more will come of it."""


class Engine(Protocol):
    """Something that fits jobs side by side. `messages` brings updates and remarks while it does."""

    messages: Queue[Any]

    def submit(self, job: Job) -> Pending:
        """Hands over a job."""

    def outcome(self, pending: Any, job: Job) -> MemberResult | None:
        """What became of a job that is done: None if it was stopped before it began. Raises ComputationError."""

    def stop(self) -> None:
        """Tells every worker to end after its iteration, and to begin no other job."""


def _collect(engine: Engine, jobs: Sequence[Job], progress: Progress, take: Take) -> None:
    """Waits for all jobs. On SIGINT every worker is told to stop after its iteration, and is waited for.

    So they are where one of them raises UserError, which is then raised here.
    """
    waiting = [(engine.submit(job), job) for job in jobs]
    stopped, wrong = False, None
    with uninterrupted() as interrupted:
        while waiting:
            _drain(engine.messages, progress)
            if interrupted() and not stopped:
                engine.stop()
                stopped = True
            still: list[tuple[Pending, Job]] = []
            for pending, job in waiting:
                if pending.done():
                    try:
                        _take(engine, pending, job, take)
                    except UserError as error:  # the others end after their iteration, and are kept
                        wrong = error
                        engine.stop()
                else:
                    still.append((pending, job))
            waiting = still
        _drain(engine.messages, progress)
        if wrong is not None:
            raise wrong
        if interrupted():
            raise KeyboardInterrupt


def _take(engine: Engine, pending: Pending, job: Job, take: Take) -> None:
    """Hands on what became of a job that is done."""
    try:
        result = engine.outcome(pending, job)
    except ComputationError as error:
        take(job, error)
    else:
        if result is not None:
            take(job, result)


def _drain(queue: Queue[Any], progress: Progress) -> None:
    """Passes on what workers told, waiting a moment for the first."""
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


class Sender:
    """Progress that goes elsewhere, item by item: an Update or a text."""

    def __init__(self, send: Callable[[Any], None]) -> None:
        self.send = send

    def update(self, update: Update) -> None:
        """Sends it."""
        self.send(update)

    def message(self, text: str) -> None:
        """Sends it."""
        self.send(text)


@contextmanager
def _processes(workers: int, threads: int) -> Iterator[Engine]:
    """A pool of spawned processes, each with its own torch and its own number of threads."""
    spawn = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    try:
        with (
            _without_main(),
            spawn.Manager() as manager,
            ProcessPoolExecutor(workers, mp_context=spawn) as pool,
        ):
            yield _Processes(pool, manager.Queue(), manager.Event(), threads)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def _without_main() -> Iterator[None]:
    """Within it spawned processes do not run the main script again: a script that trains would train there too."""
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {name: vars(main).pop(name) for name in ["__file__", "__spec__"] if name in vars(main)}
    vars(main)["__spec__"] = None
    try:
        yield
    finally:
        vars(main).update(hidden)


class _Processes:
    def __init__(self, pool: ProcessPoolExecutor, messages: Queue[Any], stopped: Event, threads: int) -> None:
        self.pool, self.messages, self.stopped, self.threads = pool, messages, stopped, threads

    def submit(self, job: Job) -> Pending:
        return self.pool.submit(_work, job, self.threads, self.messages, self.stopped)

    def outcome(self, pending: Any, job: Job) -> MemberResult | None:
        try:
            result: MemberResult | None = pending.result()
        except BrokenProcessPool:
            what = f"the process that fitted {job.name} was killed (possibly because memory was exhausted)"
            raise ComputationError(what, remedy="use fewer `--workers`; `--resume` continues the run") from None
        return result

    def stop(self) -> None:
        self.stopped.set()


def _work(job: Job, threads: int, messages: Queue[Any], stopped: Event) -> MemberResult | None:
    """One member, in a worker. An interruption comes back as an unfinished result: the weights are written."""
    use_threads(threads)
    if stopped.is_set():
        return None
    try:
        return fit(job, Sender(messages.put), stopped.is_set)
    except Interrupted as interruption:
        return interruption.result
