"""Members to be fitted as jobs, and what workers that fit them side by side must offer."""

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


class Pending(Protocol):
    """A job that workers have been given."""

    def done(self) -> bool:
        """Whether nothing more will come of it."""


class Workers(Protocol):
    """What fits jobs side by side: processes, or a cluster. `messages` brings updates and remarks while it does."""

    messages: Queue[Update | str]

    def submit(self, job: Job) -> Pending:
        """Hands over a job."""

    def outcome(self, pending: Any, job: Job) -> MemberResult | None:
        """What became of a job that is done: None if it was stopped before it began. Raises ComputationError."""

    def stop(self) -> None:
        """Tells every worker to end after its iteration, and to begin no other job."""


class Sender:
    """Progress that goes elsewhere, item by item: an Update or a text."""

    def __init__(self, send: Callable[[Update | str], None]) -> None:
        self.send = send

    def update(self, update: Update) -> None:
        """Sends it."""
        self.send(update)

    def message(self, text: str) -> None:
        """Sends it."""
        self.send(text)
