"""One member of a study: simulates (or reads) its data, fits it, and compares the fit with the truth."""

from __future__ import annotations

import contextlib
import json
import math
import platform
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.json_values import JsonObject
from gbspec.runs import encode, files
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


def read_record(path: Path) -> JsonObject | None:
    """The record of a finished member; None if there is none or it is damaged."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError):
        return None
    return found if isinstance(found, dict) and "settings" in found else None


def fit_member(task: Task, place: Place, threads: int = 1, keep: bool = False) -> JsonObject:
    """Simulates, trains, validates, and writes the member's record; an interrupted fit is continued.

    A fit that fails is a result too: its record has a `failure`. Raises KeyboardInterrupt after saving the
    intermediate result.
    """
    resumed = (place.run(task) / files.FIT).is_file()
    record: JsonObject = {
        "case": task.case.name,
        "member": task.member,
        "seed": task.seed,
        "settings": task.settings,
        "resumed": resumed,
        "finished": "",
    }
    began = time.process_time(), time.monotonic()
    try:
        record |= _reached(task, place, threads, resumed, began)
    except ComputationError as error:
        record["failure"] = " - ".join(part for part in (error.what, error.where) if part)
    except UserError as error:
        record["failure"] = "; ".join(diagnostic.message for diagnostic in error.diagnostics)
    record["finished"] = datetime.now(UTC).isoformat(timespec="seconds")
    record["machine"] = f"{platform.machine()} {platform.system()}"
    files.write_json(place.record(task), record)
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


def _reached(task: Task, place: Place, threads: int, resumed: bool, began: tuple[float, float]) -> JsonObject:
    from gbspec import frontend
    from gbspec.operations import fitting

    model = frontend.load_model(str(task.case.model), Findings())
    data = measured(task, model, place)
    prepared = time.process_time(), time.monotonic()
    options = replace(task.training, seed=task.seed, resume=resumed, threads=threads)
    run = fitting.fit(model, data, place.run(task), options)
    fitted = time.process_time(), time.monotonic()
    found = check(run, data, task)
    return {
        "data": {"trajectories": len(data), "rows": data.rows, "values": data.measurements},
        "cpu_seconds": fitted[0] - prepared[0],
        "wall_seconds": fitted[1] - prepared[1],
        "other_cpu_seconds": time.process_time() - fitted[0] + prepared[0] - began[0],
        "loss": run.fit.members[0].loss,
        "stages": [encode(stage) for stage in run.fit.members[0].stages],
        "constants": {name: entry.value for name, entry in run.fit.constants.items()},
        "max_step": run.max_step,
        **found,
        **starts(run, data, task),
        "versions": {"gbspec": run.fit.gbspec, **run.fit.versions},
    }


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
        temporary = path.with_suffix(".part.csv")
        write(temporary, made, model)
        temporary.replace(path)
    return tables.read_data(path, model, Findings())


def check(run: Run, data: Trajectories, task: Task) -> JsonObject:
    """The errors of a fitted member on its data and against the truth, and the warnings."""
    from gbspec.analysis import validate

    found = validate(run, data, member=0, sampling=task.case.sampling, metrics=task.case.metrics)
    return {
        "errors": errors_of(found),
        "nrmse": {name: errors.nrmse for name, errors in found.channels.items()},
        "unsolved": list(found.failed),
        "step_check": found.step_check.to_json(),
        "step_warning": found.step_check.warning,
        "warnings": [*run.fit.warnings, *found.warnings],
    }


def starts(run: Run, data: Trajectories, task: Task) -> JsonObject:
    """The tables on initial states that the case requests, from the known truth of simulated data."""
    if not task.case.tables or task.case.data is not None:
        return {}
    from gbspec.studies.starts import Starts

    known = Starts.of(run, data, replace(task.case.sampling, seed=task.seed))
    asked = {"eigenvalues": known.eigenvalues, "initial-states": known.initial_states}
    return {name.replace("-", "_"): make() for name, make in asked.items() if name in task.case.tables}


def errors_of(found: Validation) -> dict[str, Mapping[str, float | int]]:
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
    shown: dict[str, Mapping[str, float | int]] = {
        name: {**{norm: getattr(one, norm) for norm in NORMS}, "failed": one.failed} for name, one in norms.items()
    }
    if truth.constants:
        shown["constants"] = {"L2": truth.constants["all"], **truth.constants}
    return shown
