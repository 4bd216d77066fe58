"""Cross-validation: for each fold, a fit without its data, and the errors of predicting them.

The directory of a cross-validation contains a run directory for each fold (`folds/K`), the predictions of its fit
(`folds/K.json`, written last, so that a fold with this file is finished), and the tables over all folds.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.data import Trajectories, fingerprint, for_spreadsheets
from gbspec.diagnostics import ComputationError, Diagnostic, UserError
from gbspec.files import clear, finite, write_text
from gbspec.frames import Tabled, of_rows
from gbspec.given import is_whole, shown
from gbspec.json_values import JsonObject
from gbspec.runs import OMITTED, JsonError, decode, encode, files, locked, read_object
from gbspec.studies.folds import Fold, Over, folds, way
from gbspec.studies.heldout import Errors, Point, errors, errors_one_ahead, held_out

if TYPE_CHECKING:
    import polars as pl

    from gbspec.ir import Model
    from gbspec.training import Progress, TrainOptions

SUMMARY = "crossvalidation.json"


@dataclass(frozen=True)
class CrossOptions:
    """How `gbspec crossvalidate` divides the data and predicts the held-out part."""

    folds: int | None = field(
        default=None,
        metadata={
            "help": "Number of folds; default: one per trajectory for up to 20 trajectories, else 5.",
            "metavar": "K",
        },
    )
    over: Over | None = field(
        default=None,
        metadata={"help": "Leave out trajectories, or blocks of successive rows (always for a single trajectory)."},
    )
    window: int | None = field(
        default=None,
        metadata={
            "help": "Number of measured rows from which the initial state of a left-out trajectory is estimated; "
            "default: a third of them, at least three.",
            "metavar": "ROWS",
        },
    )

    def check(self) -> None:
        """Raises `UserError` (GB814) if a value is invalid."""
        for name, value, least in (("folds", self.folds, 2), ("window", self.window, 1)):
            if value is not None and not (is_whole(value) and value >= least):
                message = f"`--{name} {shown(value)}` must be a whole number, at least {least}"
                raise UserError([Diagnostic("GB814", message, None)])


@dataclass(frozen=True, repr=False)
class CrossValidation(Tabled):
    """Errors of each fold and of all held-out measurements together; `failures`: the reason for each failed fold.

    `ahead`: those of all together, predicted from the measurements up to the row before by fits without the block;
    empty for models without random disturbances.
    """

    model: str
    over: Over
    count: int
    folds: Mapping[int, Mapping[str, Errors]]
    total: Mapping[str, Errors]
    failures: Mapping[int, str]
    points: tuple[Point, ...] = field(repr=False, default=())
    ahead: Mapping[str, Errors] = field(default_factory=dict)

    def to_frame(self) -> pl.DataFrame:
        """The errors of each fold and channel, in the channel's unit; those of all folds together have no `fold`."""
        parts: list[tuple[int | None, Mapping[str, Errors]]] = [*self.folds.items(), (None, self.total)]
        return of_rows(
            {"fold": fold, "channel": name, **one.to_json()} for fold, part in parts for name, one in part.items()
        )

    def summary(self) -> str:
        """What was held out."""
        return f"{self.model}, {self.count} folds over {self.over}"

    def to_json(self) -> dict[str, object]:
        """The content of `crossvalidate --json`."""
        return {
            "model": self.model,
            "over": self.over,
            "folds": [
                {
                    "fold": number,
                    "failure": self.failures.get(number),
                    "channels": {name: one.to_json() for name, one in self.folds.get(number, {}).items()},
                }
                for number in range(self.count)
            ],
            "total": {name: one.to_json() for name, one in self.total.items()},
            "ahead": {name: one.to_json() for name, one in self.ahead.items()},
        }


@dataclass(frozen=True)
class FoldRecord:
    """A finished fold: its held-out measurements with their predictions, and the reason if its fit failed."""

    fold: int
    points: tuple[Point, ...]
    failure: str | None = field(default=None, metadata=OMITTED)

    def to_json(self) -> JsonObject:
        """The content of the fold's file; predictions that are not finite are left out."""
        document: JsonObject = encode(self)
        document["points"] = [
            {name: value for name, value in point.items() if not isinstance(value, float) or math.isfinite(value)}
            for point in document["points"]
        ]
        return document


def crossvalidate(
    model: Model,
    data: Trajectories,
    directory: Path,
    training: TrainOptions,
    options: CrossOptions,
    progress: Callable[[Fold], Progress],
) -> CrossValidation:
    """Fits the model without each fold and predicts the fold; finished folds are kept, an interrupted one is continued.

    Raises UserError (GB814; GB820 if the directory belongs to something else; GB821 if the data cannot be divided), and
    ComputationError if no fold could be fitted.
    """
    from gbspec.data import absent_channels, absent_states

    options.check()
    over = way(data, options.over)
    absent = absent_channels(model, absent_states(model, data.items))
    parts = folds(data, over, options.folds, training.seed, absent)
    with locked(directory):
        clear(directory)
        _begin(directory, model, data, training, options)
        return _crossvalidated(model, data, directory, training, options, progress, parts, over)


def _crossvalidated(
    model: Model,
    data: Trajectories,
    directory: Path,
    training: TrainOptions,
    options: CrossOptions,
    progress: Callable[[Fold], Progress],
    parts: Sequence[Fold],
    over: Over,
) -> CrossValidation:
    sds = _sds(data)
    found: dict[int, list[Point]] = {}
    failures: dict[int, str] = {}
    for fold in parts:
        path = directory / "folds" / f"{fold.number}.json"
        record = _read(path) or _fitted(model, fold, directory, training, options, progress(fold), path)
        if record.failure is not None:
            failures[fold.number] = record.failure
        found[fold.number] = list(record.points)
    if len(failures) == len(parts):
        raise ComputationError(
            f"no fold could be fitted: {failures[0]}", remedy="try `gbspec train` on all of the data"
        )
    every = tuple(point for points in found.values() for point in points)
    each = {number: errors(points, sds) for number, points in found.items()}
    ahead = errors_one_ahead(every, sds)
    made = CrossValidation(model.name, over, len(parts), each, errors(every, sds), failures, every, ahead)
    _write(directory, made, found)
    return made


def _begin(directory: Path, model: Model, data: Trajectories, training: TrainOptions, options: CrossOptions) -> None:
    """Records model, data and options, or refuses to continue a cross-validation begun with others (GB820)."""
    fixed = training.settings(("workers", "threads", "scheduler"))
    content = [fingerprint(item) for item in data.items]
    parts = [hashlib.sha256(model.text.encode()).hexdigest(), content, fixed, asdict(options)]
    settings = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    path = directory / "folds" / "settings.json"
    try:
        before = read_object(path).get("settings")
    except (OSError, JsonError):
        files.write_json(path, {"settings": settings, "options": fixed, **asdict(options)})
        return
    if before != settings:
        message = f"`{directory}` was begun with another model, other data or other options"
        raise UserError([Diagnostic("GB820", message, None, help="name another directory with `-o`")])


def _read(path: Path) -> FoldRecord | None:
    """The record of a finished fold; None if there is none or it is damaged."""
    try:
        return decode(FoldRecord, read_object(path))
    except (OSError, JsonError):
        return None


def _fitted(
    model: Model,
    fold: Fold,
    directory: Path,
    training: TrainOptions,
    options: CrossOptions,
    progress: Progress,
    path: Path,
) -> FoldRecord:
    """Fits without a fold, predicts it, and writes its record."""
    from gbspec.operations import fitting

    place = directory / "folds" / str(fold.number)
    resumed = replace(training, resume=(place / files.FIT).is_file())
    try:
        run = fitting.fit(model, fold.kept, place, resumed, progress)
        record = FoldRecord(fold.number, tuple(held_out(run, fold, options.window)))
    except ComputationError as error:
        record = FoldRecord(fold.number, (), " - ".join(part for part in (error.what, error.where) if part))
    except UserError as error:
        without = "rows at the start of each trajectory" if fold.number == 0 else "a block of rows"
        left = without if fold.over == "time" else ", ".join(f"`{item.label}`" for item in fold.whole.items)
        note = f"in fold {fold.number}, whose fit is without {left}"
        raise UserError([replace(one, notes=(*one.notes, note)) for one in error.diagnostics]) from None
    files.write_json(path, record.to_json())
    return record


def _sds(data: Trajectories) -> dict[str, float]:
    """The standard deviation of each channel over all data."""
    from gbspec.data import channel_statistics

    return {one.name: one.scale for one in channel_statistics(data)}


# ------------------------------------------------------------------------------------------------------------ tables
def _write(directory: Path, made: CrossValidation, found: Mapping[int, Sequence[Point]]) -> None:
    files.write_json(directory / SUMMARY, made.to_json())
    write_text(directory / "table.md", markdown(made))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    given = ["fold", "trajectory", "time", "channel", "measured"]
    writer.writerow([*given, "predicted", "sd", "one_ahead", "one_ahead_sd"])
    for number, points in found.items():
        for p in points:
            numbers = ["" if finite(v) is None else v for v in (p.predicted, p.sd, p.ahead, p.ahead_sd)]
            writer.writerow([number, for_spreadsheets(p.trajectory), p.time, p.channel, p.measured, *numbers])
    write_text(directory / "predictions.csv", text.getvalue())


def markdown(made: CrossValidation) -> str:
    """The table in Markdown."""
    words = {"trajectories": "trajectories", "time": "successive rows"}
    lines = [
        f"# Cross-validation of {made.model}",
        "",
        f"{made.count} folds of {words[made.over]}; errors on the left-out measurements.",
        "",
        "| fold | channel | n | rmse | nrmse | mae | rmse of logarithms | in the 90 % interval |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for number in range(made.count):
        if number in made.failures:
            lines.append(f"| {number} | failed: {made.failures[number]} |  |  |  |  |  |  |")
        lines += [_row(str(number), name, one) for name, one in made.folds.get(number, {}).items()]
    lines += [_row("all", name, one) for name, one in made.total.items()]
    lines += [_row("all, one row ahead", name, one) for name, one in made.ahead.items()]
    lines += [
        f"\n{one.unsolved} measurements of {name} have no prediction: the solution blew up before them."
        for name, one in made.total.items()
        if one.unsolved
    ]
    return "\n".join(lines) + "\n"


def _row(fold: str, channel: str, one: Errors) -> str:
    numbers = ["" if finite(v) is None else f"{v:.4g}" for v in (one.rmse, one.nrmse, one.mae, one.rmse_log)]
    covered = "" if finite(one.covered) is None else f"{100 * one.covered:.0f} %"
    return "| " + " | ".join([fold, channel, str(one.n), *numbers, covered]) + " |"
