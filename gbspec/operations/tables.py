"""Tables of measurements: simulated, read from a file, or the training data of a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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
    """Simulated measurements of a subject; conditions that were set keep their values."""
    from gbspec.analysis import simulate as run
    from gbspec.data import fixed

    return run(source.evaluator, source.model, fixed(options, source.values, source.model), like, progress)


def far_outside(data: Trajectories, model: Model) -> list[str]:
    """A sentence for each measured state with values far outside of its declared range."""
    from gbspec.data import far_outside as judged

    return judged(model, np.concatenate([item.values for item in data.items]))


def read_data(path: str | Path, model: Model, findings: Findings, *, require_channels: bool = True) -> Trajectories:
    """A table of measurements for a model. Raises `UserError` with all errors in it."""
    from gbspec.data import read

    return read(path, model, findings, require_channels)


def training_data(run: Run, findings: Findings) -> Trajectories | None:
    """The table that a run was trained on; None if it is no longer at its path."""
    path = run.fit.data.path
    return read_data(path, run.model, findings) if path and Path(path).is_file() else None


def trained_on(run: Run, path: str | Path | None, findings: Findings) -> Trajectories:
    """The data that a run was trained on, from `path` if they were moved; continuing a fit needs the same data.

    Raises `UserError` (GB859) if they are not found, or differ.
    """
    data = training_data(run, findings) if path is None else read_data(path, run.model, findings)
    if data is None:
        message = f"the table that the run was trained on, `{run.fit.data.path}`, is no longer at that path"
        raise UserError([Diagnostic("GB859", message, None, help="give its path: `--data TABLE`")])
    if data.sha256 != run.fit.data.sha256:
        message = f"`{data.path}` is not the table that the run was trained on"
        help = "continuing the fit needs the same table, unchanged"
        raise UserError([Diagnostic("GB859", message, None, help=help)])
    return data
