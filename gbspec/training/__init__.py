"""Estimation: from trajectories to weights, constants and initial states."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from gbspec.training.options import TrainOptions
from gbspec.training.progress import Progress, Silent, Update

if TYPE_CHECKING:
    from gbspec.data.trajectories import Trajectories
    from gbspec.ir.model import Model
    from gbspec.runs.store import Run

__all__ = ["Progress", "Silent", "TrainOptions", "Update", "train"]


def train(
    model: Model,
    trajectories: Trajectories,
    options: TrainOptions,
    directory: Path | str,
    progress: Progress | None = None,
) -> Run:
    """Fits a model to data and writes a run directory; see `runs.fit.train`, which this loads with torch."""
    from gbspec.training.runs.fit import train as fit

    return fit(model, trajectories, options, directory, progress)
