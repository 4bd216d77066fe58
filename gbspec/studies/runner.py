"""Runs the tasks of a study, each in a separate process, and rewrites the tables after each.

Separate processes allow the CPU time of each member to be measured, and the study survives a process that is killed for
lack of memory. Finished members have a record and are never refitted; an unfinished one continues from its checkpoint.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path

from gbspec.diagnostics import ComputationError, Diagnostic, Findings, UserError
from gbspec.files import clear
from gbspec.runs import locked
from gbspec.studies.member import Place, fit_member
from gbspec.studies.options import StudyOptions
from gbspec.studies.record import Record, Summary, read_record
from gbspec.studies.tables import write_tables
from gbspec.studies.tasks import Study, Task

POLL = 0.2
"""Seconds between polls of the workers."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

Told = Callable[[Task, Record, int, int], None]
"""Called with a finished task, its record, the number of finished tasks, and the number of all tasks."""


def run_study(study: Study, root: Path, options: StudyOptions, command: str, told: Told) -> Summary:
    """Fits what is not fitted yet (nothing with `--table-only`) and writes the tables; gives `study.json`'s content.

    Raises UserError (GB820) if the directory holds a study with other settings, ComputationError if the process of a
    member died, KeyboardInterrupt once the workers are stopped.
    """
    place = Place(root)
    tasks = study.tasks()
    check_settings(tasks, place)
    waiting = [] if options.table_only else [task for task in tasks if read_record(place.record(task)) is None]
    if not waiting:
        return write_tables(study, place, command)
    check_models(study)
    with locked(root):
        clear(root)
        return _run(study, tasks, waiting, place, options, command, told)


def _run(
    study: Study,
    tasks: list[Task],
    waiting: list[Task],
    place: Place,
    options: StudyOptions,
    command: str,
    told: Told,
) -> Summary:
    """Fits the waiting tasks and writes the tables."""
    # With `--keep-runs` every member has its own run.
    equal = {} if options.keep_runs else equal_tasks(tasks)
    share_records(equal, place)
    waiting = [task for task in waiting if task.name not in equal]
    summary = write_tables(study, place, command)

    def finished(task: Task, record: Record) -> None:
        nonlocal summary
        share_records(equal, place)
        summary = write_tables(study, place, command)
        done = sum(case.members for case in summary.cases.values())
        told(task, record, done, len(tasks))

    with _terminable():
        _fit(waiting, place, options, finished)
    return summary


def equal_tasks(tasks: Sequence[Task]) -> dict[str, tuple[Task, Task]]:
    """Tasks by name that need the same fit as an earlier task (same model, data, options, tables), with that task."""
    first: dict[tuple[object, ...], Task] = {}
    equal: dict[str, tuple[Task, Task]] = {}
    settings = {task.case.name: task.settings for task in tasks if task.member == 0}
    for task in tasks:
        other = first.setdefault((settings[task.case.name], task.seed, task.case.tables), task)
        if other is not task:
            equal[task.name] = task, other
    return equal


def share_records(equal: Mapping[str, tuple[Task, Task]], place: Place) -> None:
    """Copies the record of the equal task, if it is finished, to each task without a record."""
    for task, other in equal.values():
        if read_record(place.record(task)) is None:
            record = read_record(place.record(other))
            if record is not None:
                replace(record, case=task.case.name, fit_of=other.case.name).write(place.record(task))


def check_models(study: Study) -> None:
    """Raises UserError if a case's model is invalid, or has no truth although its data are to be simulated."""
    from gbspec import frontend
    from gbspec.passes import with_truth

    models = {case.model: frontend.load_model(str(case.model), Findings()) for case in study.cases}
    for case in study.cases:
        if case.data is None:
            with_truth(models[case.model])


def check_settings(tasks: list[Task], place: Place) -> None:
    """Raises UserError (GB820) if finished members of a case were fitted with other settings."""
    settings: dict[str, str] = {}
    for task in tasks:
        record = read_record(place.record(task))
        if record is None:
            continue
        if task.case.name not in settings:
            settings[task.case.name] = task.settings
        if record.settings != settings[task.case.name] or record.seed != task.seed:
            message = f"the study in `{place.root}` was begun with other settings of the case `{task.case.name}`"
            advice = "name another directory with `-o`, or give the options (and the case) as they were"
            raise UserError([Diagnostic("GB820", message, None, help=advice)])


def _fit(waiting: list[Task], place: Place, options: StudyOptions, finished: Callable[[Task, Record], None]) -> None:
    """Keeps `--workers` processes busy until all tasks have a record."""
    running: dict[BaseProcess, Task] = {}
    lost: list[str] = []
    rest = list(waiting)
    try:
        while rest or running:
            while rest and len(running) < options.workers:
                task = rest.pop(0)
                running[_start(task, place, options)] = task
            for process in [one for one in running if not one.is_alive()]:
                task = running.pop(process)
                process.join()
                record = read_record(place.record(task))
                if record is not None:
                    finished(task, record)
                else:
                    lost.append(f"{task.name} ({_ending(process)})")
            time.sleep(POLL)
    finally:
        for process in running:  # any are left only after an interruption; their checkpoints are seconds old
            process.terminate()
            process.join()
    if lost:
        raise ComputationError(
            f"the process of {', '.join(lost)} ended without a result",
            remedy="if it was killed, possibly because memory was exhausted, use fewer `--workers`; the same command "
            "continues the study",
        )


def _ending(process: BaseProcess) -> str:
    code = process.exitcode or 0
    return f"killed by signal {-code}" if code < 0 else f"exit status {code}"


def _start(task: Task, place: Place, options: StudyOptions) -> BaseProcess:
    """A new process for a task, with the threads of a worker."""
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(options.threads)))
    try:
        spawn = multiprocessing.get_context("spawn")
        process = spawn.Process(target=_work, args=(task, place, options.threads, options.keep_runs))
        process.start()
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
    return process


def _work(task: Task, place: Place, threads: int, keep: bool) -> None:
    """Fits one member in its process, which leaves the terminal's process group: only the parent receives Ctrl-C."""
    if hasattr(os, "setpgrp"):
        os.setpgrp()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    fit_member(task, place, threads, keep)


def _end_with_parent() -> None:
    """Makes this worker end with its parent, since another study may already have begun the same member."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _terminable() -> Iterator[None]:
    """A context in which SIGTERM and SIGHUP, which end jobs of a batch system, have the effect of Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():  # only there signals can be asked for
        yield
        return
    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    asking = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _raise_interrupt) for number in asking}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _raise_interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
