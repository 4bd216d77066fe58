"""One member of a study: simulates (or reads) its data, fits it, and compares the fit with the truth."""

from __future__ import annotations

import contextlib
import math
import platform
import shutil
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.runs import files
from gbspec.studies.record import Counts, Eigenvalues, Fitted, InitialStates, Norms, Record
from gbspec.studies.tasks import Task

if TYPE_CHECKING:
    from gbspec.analysis import Validation
    from gbspec.data import Trajectories
    from gbspec.ir import Model
    from gbspec.runs import Run

NORMS = ("L1", "L2", "Linf")


@dataclass(frozen=True)
class Place:
    """The locations of a study's files."""

    root: Path

    def record(self, task: Task) -> Path:
        """The record of a finished member; it is written last, so that a member with a record is finished."""
        return self.root / "members" / task.case.name / f"{task.member}.json"

    def run(self, task: Task) -> Path:
        """The member's run directory, in which an interrupted fit is continued."""
        return self.root / "runs" / task.case.name / str(task.member)

    def table(self, task: Task) -> Path:
        """The table of the member's data."""
        return self.root / "runs" / task.case.name / f"{task.member}.csv"


def fit_member(task: Task, place: Place, threads: int = 1, keep: bool = False) -> Record:
    """Simulates, trains, validates, and writes the member's record; an interrupted fit is continued.

    A fit that fails is a result too: its record has a `failure`. Raises KeyboardInterrupt after saving the
    intermediate result.
    """
    resumed = (place.run(task) / files.FIT).is_file()
    record = Record(case=task.case.name, member=task.member, seed=task.seed, settings=task.settings, resumed=resumed)
    began = time.process_time(), time.monotonic()
    try:
        record = replace(record, fitted=_fitted(task, place, threads, resumed, began))
    except ComputationError as error:
        record = replace(record, failure=" - ".join(part for part in (error.what, error.where) if part))
    except UserError as error:
        if any(diagnostic.code == "GB864" for diagnostic in error.diagnostics):
            raise  # another process fits the member: no result of this one
        record = replace(record, failure="; ".join(diagnostic.message for diagnostic in error.diagnostics))
    finished = datetime.now(UTC).isoformat(timespec="seconds")
    record = replace(record, finished=finished, machine=f"{platform.machine()} {platform.system()}")
    record.write(place.record(task))
    if not keep:
        discard(task, place)
    return record


def discard(task: Task, place: Place) -> None:
    """Removes the member's run and table, and the folders around them once they are empty."""
    shutil.rmtree(place.run(task), ignore_errors=True)
    place.table(task).unlink(missing_ok=True)
    for folder in (place.run(task).parent, place.run(task).parent.parent):
        with contextlib.suppress(OSError):  # not empty: other members are still in progress there
            folder.rmdir()


def _fitted(task: Task, place: Place, threads: int, resumed: bool, began: tuple[float, float]) -> Fitted:
    from gbspec import frontend
    from gbspec.operations import fitting

    model = frontend.load_model(str(task.case.model), Findings())
    data = measured(task, model, place)
    prepared = time.process_time(), time.monotonic()
    options = replace(task.training, seed=task.seed, resume=resumed, threads=threads)
    run = fitting.fit(model, data, place.run(task), options)
    fitted = time.process_time(), time.monotonic()
    found = check(run, data, task)
    member = run.fit.members[0]
    eigenvalues, initial_states = starts(run, data, task)
    return Fitted(
        data=Counts(len(data), data.rows, data.measurements),
        cpu_seconds=fitted[0] - prepared[0],
        wall_seconds=fitted[1] - prepared[1],
        other_cpu_seconds=time.process_time() - fitted[0] + prepared[0] - began[0],
        loss=member.loss,
        stages=member.stages,
        constants={name: entry.value for name, entry in run.fit.constants.items()},
        max_step=run.step(run.numbers[0]),
        errors=errors_of(found),
        nrmse={name: errors.nrmse for name, errors in found.channels.items()},
        unsolved=tuple(found.failed),
        step_check=found.step_check.record(),
        step_warning=found.step_check.warning,
        warnings=(*run.fit.warnings, *found.warnings),
        eigenvalues=eigenvalues,
        initial_states=initial_states,
        versions={"gbspec": run.fit.gbspec, **run.fit.versions},
    )


def measured(task: Task, model: Model, place: Place) -> Trajectories:
    """The member's data: the case's table, or simulated data, read back from a table like a user's."""
    from gbspec.data import write
    from gbspec.operations import models, tables

    if task.case.data is not None:
        return tables.read_data(task.case.data, model, Findings())
    path = place.table(task)
    if not path.is_file():
        made = tables.simulate(models.reference(model), replace(task.case.sampling, seed=task.seed))
        path.parent.mkdir(parents=True, exist_ok=True)
        write(path, made, model)
    return tables.read_data(path, model, Findings())


def check(run: Run, data: Trajectories, task: Task) -> Validation:
    """The errors of a fitted member on its data and against the truth, and the warnings."""
    from gbspec.analysis import validate

    return validate(run, data, member=0, sampling=task.case.sampling, metrics=task.case.metrics)


def starts(run: Run, data: Trajectories, task: Task) -> tuple[Eigenvalues | None, InitialStates | None]:
    """The tables on initial states that the case requests, from the known truth of simulated data."""
    asked = task.case.tables
    if not asked or task.case.data is not None:
        return None, None
    from gbspec.studies.starts import Starts

    known = Starts.of(run, data, replace(task.case.sampling, seed=task.seed))
    return (
        known.eigenvalues() if "eigenvalues" in asked else None,
        known.initial_states() if "initial-states" in asked else None,
    )


def errors_of(found: Validation) -> dict[str, Norms]:
    """The norms of each metric against the truth; for constants the mean relative error, as `L2` (the paper's name).

    Without a truth, the mean NRMSE of the channels on the data, infinite if a trajectory could not be solved.
    """
    truth = found.truth
    if truth is None:
        nrmse = [one.nrmse for one in found.channels.values() if one.n]
        return {"data": {"L2": sum(nrmse) / len(nrmse) if nrmse else math.nan, "failed": len(found.failed)}}
    norms = {"solution": truth.solution, "rhs": truth.rhs}
    if truth.functions:
        norms["functions"] = truth.functions["all"]
    shown: dict[str, Norms] = {
        name: {**{norm: getattr(one, norm) for norm in NORMS}, "failed": one.failed} for name, one in norms.items()
    }
    if truth.constants:
        shown["constants"] = {"L2": truth.constants["all"], **truth.constants}
    return shown
