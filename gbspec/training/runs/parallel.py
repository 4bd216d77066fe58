"""Fitting members: one after the other in this process, or in parallel by workers (processes, a cluster)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from queue import Empty, Queue

from gbspec.diagnostics import ComputationError, UserError
from gbspec.training.optimise import use_threads
from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Update
from gbspec.training.runs.cluster import cluster
from gbspec.training.runs.jobs import Job, Pending, Take, Workers, fit
from gbspec.training.runs.member import Interrupted
from gbspec.training.runs.processes import processes
from gbspec.training.runs.signals import uninterrupted


def cores() -> int:
    """Processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def fit_jobs(jobs: Sequence[Job], options: TrainOptions, progress: Progress, take: Take) -> None:
    """Fits all jobs with the workers, threads and scheduler that `options` specifies.

    Raises KeyboardInterrupt when the process is asked to end (Ctrl-C, SIGTERM, SIGHUP), after every running member has
    written its result and `take` has received it.
    """
    if options.scheduler is not None:
        with cluster(options.scheduler, options.threads or 1) as fitting:
            _collect(fitting, jobs, progress, take)
        return
    default = cores() if options.device == "cpu" else 1
    workers = min(options.workers or default, len(jobs))
    threads = options.threads or max(1, cores() // max(workers, 1))
    if workers > 1:
        with processes(workers, threads) as fitting:
            _collect(fitting, jobs, progress, take)
        return
    use_threads(threads)
    with uninterrupted() as interrupted:  # between two members too
        for job in jobs:
            if interrupted():
                raise KeyboardInterrupt
            try:
                take(job, fit(job, progress))
            except ComputationError as error:
                take(job, error)
            except Interrupted as interruption:
                take(job, interruption.result)
                raise


def _collect(workers: Workers, jobs: Sequence[Job], progress: Progress, take: Take) -> None:
    """Waits for all jobs. Asked to end, stops every worker after its current iteration and waits for it.

    The same is done if a job raises UserError, which is then raised here.
    """
    stopped, wrong = False, None
    with uninterrupted() as interrupted:
        waiting = [(workers.submit(job), job) for job in jobs]
        while waiting:
            _drain(workers.messages, progress)
            if interrupted() and not stopped:
                workers.stop()
                stopped = True
            still: list[tuple[Pending, Job]] = []
            for pending, job in waiting:
                if pending.done():
                    try:
                        _take(workers, pending, job, take)
                    except UserError as error:  # the others end after their iteration, and their results are kept
                        wrong = error
                        workers.stop()
                else:
                    still.append((pending, job))
            waiting = still
        _drain(workers.messages, progress)
        if wrong is not None:
            raise wrong
        if interrupted():
            raise KeyboardInterrupt


def _take(workers: Workers, pending: Pending, job: Job, take: Take) -> None:
    """Passes the outcome of a completed job to `take`."""
    try:
        result = workers.outcome(pending, job)
    except ComputationError as error:
        take(job, error)
    else:
        if result is not None:
            take(job, result)


def _drain(queue: Queue[Update | str], progress: Progress) -> None:
    """Passes on the messages of workers, with a short wait for the first."""
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
