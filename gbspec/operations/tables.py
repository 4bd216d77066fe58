"""Tables of measurements: simulated, read from a file, or the training data of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gbspec.diagnostics import Diagnostic, Findings, UserError, packages

if TYPE_CHECKING:
    from gbspec.data import Frame, SimulateOptions, Trajectories
    from gbspec.ir import Model
    from gbspec.operations.models import Subject
    from gbspec.runs import Run


@packages()
def simulate(
    source: Subject,
    options: SimulateOptions,
    like: Trajectories | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectories:
    """Simulated measurements of a subject; conditions that were set keep their values."""
    from gbspec.analysis import simulate as run
    from gbspec.data import fixed

    chosen = fixed(options, source.values, source.model)
    return run(source.evaluator, source.model, chosen, like, progress, source.individuals)


def far_outside(data: Trajectories, model: Model) -> list[str]:
    """A sentence for each state with values far outside of its declared range: of its solutions, where `data` were
    simulated, since many states are not measured, and of measurements, which have noise."""
    from gbspec.data import far_outside as judged

    solved = [line for line in data.meta.get("outside", "").split("\n") if line]
    told = {line.partition(":")[0] for line in solved}
    measured = judged(model, np.concatenate([item.values for item in data.items]))
    return solved + [line for line in measured if line.partition(":")[0] not in told]


def read_data(
    data: str | Path | Frame, model: Model, findings: Findings, *, require_channels: bool = True, form: str = "auto"
) -> Trajectories:
    """A table of measurements for a model, in a file or in memory. Raises `UserError` with all errors in it.

    `form` is that of `--format`: `auto`, `table`, `nonmem`, or `nonmem:1=gut,2=conc`.
    """
    from gbspec.data import format_named, is_frame, read, read_frame

    chosen = format_named(form)
    if isinstance(data, str | Path):
        return read(data, model, findings, require_channels, chosen)
    if not is_frame(data):
        kinds = "a path, a data frame of polars, pandas or pyarrow, or a mapping of names to columns"
        raise TypeError(f"data are {kinds}, not {type(data).__name__}")
    return read_frame(data, model, findings, require_channels, chosen)


def said_once(findings: Findings, run: Run, data: Trajectories) -> list[Diagnostic]:
    """What was found in a table to predict on, without empty conditions (GB793) that the prediction itself names."""
    from gbspec.analysis import defaulted

    named = {run.model.conditions[i].name for i in defaulted(run, data.items)}
    return [one for one in findings if one.code != "GB793" or one.subject not in named]


def training_data(run: Run, findings: Findings, *, required: bool = True) -> Trajectories | None:
    """The data that a run was trained on, unchanged, from wherever they are found.

    If the table is gone or was changed, raises `UserError` (GB859), or, if it is not `required`, gives a warning and
    None. None also for runs of version 0.1.0 that were trained on data in no table, which they do not keep.
    """
    kept = _kept(run)
    if kept is not None:
        return kept
    if not run.fit.data.path:
        return None
    seen: list[Path] = []
    for path in _places(run):
        if path.is_file() and path not in seen:
            if not run.fit.data.sha256 or digest(path) == run.fit.data.sha256:
                return read_data(path, run.model, findings, form=run.fit.data.format or "auto")
            seen.append(path)
    message, help = _trouble(run, seen)
    if required:
        raise UserError([Diagnostic("GB859", message, None, help=help)])
    findings.warning("GB859", message, None, help=help)
    return None


def _places(run: Run) -> list[Path]:
    """Where the table may be: at its path from this folder, at its place on this machine, beside the run as it was."""
    data = run.fit.data
    around = [run.path / data.relative] if data.relative else []
    if not data.absolute:  # a run of version 0.1.0, often beside its table
        around = [run.path.parent / data.path]
    named = [Path(text) for text in (data.path, data.absolute) if text]
    return [path.resolve() for path in (*named, *around) if "\0" not in str(path)]


def _trouble(run: Run, changed: list[Path]) -> tuple[str, str]:
    """The message and the advice for a table that is gone or was changed."""
    if changed:
        message = f"the table that the run was trained on, `{changed[0]}`, was changed after the training"
        return message, "restore it, or name the table that is meant, changed or not, in the command"
    message = f"the table that the run was trained on, `{run.fit.data.path}`, is no longer at that path"
    return message, "name its new path in the command (`--data TABLE` where it is an option)"


def _kept(run: Run) -> Trajectories | None:
    """The data that the run itself keeps; None if there are none. Raises `UserError` (GB852) if they are damaged."""
    from gbspec.data import form_of, from_arrays
    from gbspec.runs import DAMAGED, files

    path = run.path / files.DATA
    if run.fit.data.path or not path.is_file():
        return None
    try:
        arrays, remarks = files.read_tensors(path)
        labels, channels = remarks["labels"], remarks["channels"]
        found = from_arrays(arrays, labels, channels, len(run.model.inputs), len(run.model.doses))
        if found.channels != tuple(channel.name for channel in run.model.channels):
            raise ValueError(f"`{path}` is damaged: it has other channels than the model")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise UserError([Diagnostic("GB852", f"`{path}` cannot be read: {error}", None, help=DAMAGED)]) from None
    return replace(found, sha256=run.fit.data.sha256, form=form_of(run.model))


def trained_on(run: Run, given: str | Path | Frame | Trajectories | None, findings: Findings) -> Trajectories:
    """The data that a run was trained on, from those `given` if they were moved or are in a data frame; continuing a
    fit needs the same data.

    Raises `UserError` (GB859) if they are not found, or differ.
    """
    data = _read(run, given, findings)
    if data is None:
        message = "the run was trained on data in no table, and does not keep them"
        raise UserError([Diagnostic("GB859", message, None, help="give a table with the same data: `--data TABLE`")])
    if _recorded(run, data):
        return data
    own = training_data(run, Findings(), required=False)
    if own is None or not _same(own, data):
        raise UserError([_other(data, own)])
    return own


def read_for(
    run: Run,
    given: str | Path | Frame | Trajectories,
    findings: Findings,
    *,
    require_channels: bool = True,
    form: str = "auto",
) -> Trajectories:
    """Data given for a run: a table, as `read_data` reads it, or trajectories.

    Where they are another reading of the training data (see `same_content`), of which learned starts and constants of
    trajectories would not be found, these take their place, with the labels that were given. Raises `UserError` with
    all errors in a table.
    """
    from gbspec.data import Trajectories

    data = (
        given
        if isinstance(given, Trajectories)
        else read_data(given, run.model, findings, require_channels=require_channels, form=form)
    )
    counts = run.fit.data.trajectories, run.fit.data.values
    if _recorded(run, data) or counts != (len(data), data.measurements):
        return data
    missed = Findings()
    own = training_data(run, missed, required=False)
    if own is None:
        for one in missed:
            findings.add(_undecided(one))
        return data
    if not _same(own, data):
        return data
    pairs = zip(own.items, data.items, strict=True)
    return replace(own, items=tuple(replace(ours, label=theirs.label) for ours, theirs in pairs))


def read_for_subject(
    subject: Subject, data: str | Path | Frame, findings: Findings, *, require_channels: bool = True, form: str = "auto"
) -> Trajectories:
    """A table for a run, as `read_for` reads it, or for a model. Raises `UserError` with all errors in it."""
    if subject.run is not None:
        return read_for(subject.run, data, findings, require_channels=require_channels, form=form)
    return read_data(data, subject.model, findings, require_channels=require_channels, form=form)


def _undecided(trouble: Diagnostic) -> Diagnostic:
    """The warning that data as many as those of the training cannot be compared with these, for a `trouble`."""
    said = "the given data, as many as these, are taken for new ones unless they agree with these bit by bit"
    help = "restore the table, or give an unchanged copy of its file, if these are meant; new data need neither"
    return replace(trouble, message=f"{trouble.message}; {said}", help=help)


def _recorded(run: Run, data: Trajectories) -> bool:
    """Whether data are those of the training bit by bit."""
    from gbspec.data import content_digest

    known = run.fit.data.sha256, run.fit.data.content
    return data.sha256 in known or content_digest(data) in known


def _same(own: Trajectories, data: Trajectories) -> bool:
    from gbspec.data import same_content

    return same_content(own, data)


def _other(data: Trajectories, own: Trajectories | None) -> Diagnostic:
    """That data are not those of the training; where its `own` are not found, numbers were not compared one by one."""
    named = f"`{data.path}` is" if data.path else "the given data are"
    if own is not None:
        help = "continuing the fit, or reading what it learned of each trajectory, needs the same data, unchanged"
        return Diagnostic("GB859", f"{named} not what the run was trained on", None, help=help)
    message = f"{named} not bit by bit what the run was trained on, and its table is gone or was changed"
    help = "name the file of the table: other programs may round the numbers in it, or change labels (`01` to 1)"
    return Diagnostic("GB859", message, None, help=help)


def _read(run: Run, given: str | Path | Frame | Trajectories | None, findings: Findings) -> Trajectories | None:
    from gbspec.data import Trajectories

    if isinstance(given, Trajectories):
        return given
    return (
        training_data(run, findings)
        if given is None
        else read_data(given, run.model, findings, form=run.fit.data.format or "auto")
    )


def digest(path: Path) -> str:
    """The SHA-256 (hexadecimal) of a file's content."""
    from gbspec.runs import files

    return files.digest(path)
