"""Tables of measurements: simulated, read, and those that a run was trained on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.diagnostics import Diagnostic, Findings, UserError

if TYPE_CHECKING:
    from gbspec.data import SimulateOptions, Trajectories
    from gbspec.ir import Model
    from gbspec.operations.models import Subject
    from gbspec.runs import Run


def simulate(
    source: Subject,
    options: SimulateOptions,
    like: Trajectories | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Trajectories:
    """Simulated measurements of a subject; conditions that were set are held there."""
    from gbspec.analysis import simulate as run
    from gbspec.data import fixed

    return run(source.evaluator, source.model, fixed(options, source.values, source.model), like, progress)


def read_data(path: str | Path, model: Model, findings: Findings, *, require_channels: bool = True) -> Trajectories:
    """A table of measurements for a model. Raises `UserError` with everything that is wrong in it."""
    from gbspec.data import read

    return read(path, model, findings, require_channels)


def training_data(run: Run, findings: Findings) -> Trajectories | None:
    """The table that a run was trained on, None where it is no longer where it was."""
    path = run.fit.data.path
    return read_data(path, run.model, findings) if path and Path(path).is_file() else None


def trained_on(run: Run, path: str | Path | None, findings: Findings) -> Trajectories:
    """The data that a run was trained on, from `path` if they were moved; what continues a fit needs the same.

    Raises `UserError` (GB859) where they are not found, or are others.
    """
    data = training_data(run, findings) if path is None else read_data(path, run.model, findings)
    if data is None:
        message = f"the table that the run was trained on, `{run.fit.data.path}`, is not where it was"
        raise UserError([Diagnostic("GB859", message, None, help="say where it is now: `--data TABLE`")])
    if data.sha256 != run.fit.data.sha256:
        message = f"`{data.path}` is not the table that the run was trained on"
        help = "what continues the fit needs the same table, unchanged"
        raise UserError([Diagnostic("GB859", message, None, help=help)])
    return data
