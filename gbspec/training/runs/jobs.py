"""Jobs, each of which fits one member, and the interface of workers that run them in parallel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Queue
from typing import Any, Protocol

from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.diagnostics import ComputationError
from gbspec.ir import METHODS, Model
from gbspec.runs import files
from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Update
from gbspec.training.runs.member import fit_member
from gbspec.training.runs.summary import MemberResult


@dataclass(frozen=True, eq=False)
class Job:
    """One member to fit, with all data that another process needs; `run` is the run directory, `number` is unique."""

    model: Model
    trajectories: Trajectories
    options: TrainOptions
    member: int
    run: Path
    number: int

    @property
    def name(self) -> str:
        """The name of the job in messages."""
        return f"member {self.member} of `{self.run.name}`"

    @property
    def place(self) -> Path:
        """The directory of the member's files."""
        return files.member_directory(self.run, self.member)


Take = Callable[[Job, MemberResult | ComputationError], None]
"""Receives the outcome of a job as soon as it is known."""


def fit(
    job: Job, progress: Progress, stop: Callable[[], bool] = lambda: False, place: Path | None = None
) -> MemberResult:
    """Fits one member in this process, by default in its run directory; raises like `fit_member`."""
    module = load_module(job.model, METHODS[job.options.solver])
    numbered = _Numbered(progress, job.number)
    return fit_member(job.model, module, job.trajectories, job.options, job.member, place or job.place, numbered, stop)


class _Numbered:
    """Progress that identifies members by the numbers of their jobs, which differ if a sweep has several runs."""

    def __init__(self, progress: Progress, number: int) -> None:
        self.progress, self.number = progress, number

    def update(self, update: Update) -> None:
        self.progress.update(replace(update, member=self.number))

    def message(self, text: str) -> None:
        self.progress.message(text)


class Pending(Protocol):
    """A job that was submitted to workers."""

    def done(self) -> bool:
        """Whether the job has ended."""


class Workers(Protocol):
    """Processes, or a cluster, that fit jobs in parallel. The queue `messages` supplies updates and remarks."""

    messages: Queue[Update | str]

    def submit(self, job: Job) -> Pending:
        """Submits a job."""

    def outcome(self, pending: Any, job: Job) -> MemberResult | None:
        """The result of a job that has ended: None if it was stopped before it began. Raises ComputationError."""

    def stop(self) -> None:
        """Makes every worker end after its current iteration and begin no other job."""


class Sender:
    """Progress that passes each item, an Update or a text, to `send`."""

    def __init__(self, send: Callable[[Update | str], None]) -> None:
        self.send = send

    def update(self, update: Update) -> None:
        """Sends it."""
        self.send(update)

    def message(self, text: str) -> None:
        """Sends it."""
        self.send(text)
