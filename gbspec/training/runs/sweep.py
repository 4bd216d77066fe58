"""A sweep: runs with different options on the same data, with all their members fitted in parallel, and a table of the
results."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from gbspec.data import Trajectories
from gbspec.diagnostics import ComputationError, UserError
from gbspec.ir import Model
from gbspec.runs import Option, files, locked
from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Silent
from gbspec.training.runs.fit import Fitting, writing
from gbspec.training.runs.jobs import Job
from gbspec.training.runs.parallel import fit_jobs
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.variations import Point

TABLE = "sweep.csv"


@dataclass(frozen=True)
class Row:
    """A row of the table: the run's name, the varied options, and the numbers of its results by column."""

    run: str
    varied: Mapping[str, Option]
    numbers: Mapping[str, float]

    def to_json(self) -> dict[str, Option]:
        """Its cells by column."""
        return {"run": self.run, **self.varied, **self.numbers}


def sweep(
    model: Model,
    trajectories: Trajectories,
    points: Sequence[Point],
    options: TrainOptions,
    directory: Path,
    progress: Progress | None = None,
) -> list[Row]:
    """Fits every point in its own run directory under `directory`; returns (and writes) a row for each.

    `options` are those of the call: workers, threads, scheduler. A row has the run's name, the varied options, the
    members that were fitted, the smallest loss of a member, and that member's rmse of each channel and constants; these
    are missing for a point of which no member could be fitted. Raises UserError like `train`, and KeyboardInterrupt on
    SIGINT, after writing files from which the sweep can be resumed.
    """
    shown = progress or Silent()
    runs = [_fitting(model, trajectories, point, directory, shown) for point in points]
    with ExitStack() as held:
        held.enter_context(locked(directory))
        for run in runs:
            held.enter_context(writing(run.path))
            run.begin()
        return _fitted(runs, points, options, directory, shown)


def _fitted(
    runs: Sequence[Fitting], points: Sequence[Point], options: TrainOptions, directory: Path, shown: Progress
) -> list[Row]:
    """Fits the members of all runs and writes the table."""
    jobs: list[Job] = []
    of_job: dict[int, Fitting] = {}
    for run in runs:
        own = run.jobs(len(jobs))
        of_job |= dict.fromkeys((job.number for job in own), run)
        jobs += own

    def take(job: Job, outcome: MemberResult | ComputationError) -> None:
        run = of_job[job.number]
        run.take(job, outcome)
        if len(run.results) + len(run.failures) == run.options.members:
            run.write()
            done = sum(len(each.results) + len(each.failures) == each.options.members for each in runs)
            shown.message(f"[{done}/{len(runs)}] {run.path.name}: loss {_least(run):.4g}")

    try:
        fit_jobs(jobs, options, shown, take)
    except UserError:
        for run in runs:
            run.withdraw()
        raise
    finally:
        for run in runs:
            run.write()
        rows = [_row(point, run) for point, run in zip(points, runs, strict=True)]
        _write(directory / TABLE, rows)
    return rows


def _fitting(model: Model, trajectories: Trajectories, point: Point, directory: Path, shown: Progress) -> Fitting:
    """A point's run, resumed if it was begun; a continued sweep may have new points."""
    path = directory / point.name
    resume = point.options.resume and (path / files.FIT).is_file()
    return Fitting(model, trajectories, replace(point.options, resume=resume), path, shown)


def _least(run: Fitting) -> float:
    return min((result.loss for result in run.results.values()), default=math.nan)


def _row(point: Point, run: Fitting) -> Row:
    numbers: dict[str, float] = {"members": len(run.results)}
    best = min(run.results.values(), key=lambda result: result.loss, default=None)
    if best is not None:
        numbers |= {"loss": best.loss, **{f"rmse {channel}": value for channel, value in best.rmse.items()}}
        numbers |= {**best.constants, "seconds": sum(result.seconds for result in run.results.values())}
    return Row(point.name, point.varied, numbers)


def _write(path: Path, rows: Sequence[Row]) -> None:
    """Writes the table; its columns are those of the row with the most entries."""
    cells = [row.to_json() for row in rows]
    text = io.StringIO()
    fullest = max(cells, key=lambda row: len(row))
    writer = csv.DictWriter(text, list(fullest), lineterminator="\n")
    writer.writeheader()
    writer.writerows(cells)
    files.write_bytes(path, text.getvalue().encode("utf-8"))
