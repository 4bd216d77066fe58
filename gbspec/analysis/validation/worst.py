"""The measurement that is predicted worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction import Prediction, noise_at
from gbspec.arrays import Array
from gbspec.data import error_deviations
from gbspec.ir import logarithmic, on_error_scales
from gbspec.runs import OMITTED

if TYPE_CHECKING:
    from gbspec.data import Trajectories, Trajectory
    from gbspec.runs import Run


@dataclass(frozen=True)
class WorstRow:
    """The measurement that is predicted worst, by its error in standard deviations of its channel's data; of their
    logarithms, where the noise is log-normal (`logarithms`), and of counts on the scale of their noise.

    The text has the error in terms of the measurement: in its `unit`, or relative to it where logarithms are compared,
    and in standard deviations of the noise (`of_noise`) where this is known: of the larger one of that of the fit and
    of the one that the model states as a number (`stated`). Of predictions `ahead` rows ahead it is in standard
    deviations of these (`of_prediction`).
    """

    trajectory: str
    time: float
    channel: str
    measured: float
    predicted: float
    deviations: float
    logarithms: bool = field(default=False, metadata=OMITTED)
    of_noise: float | None = field(default=None, metadata=OMITTED)
    unit: str = field(default="", metadata=OMITTED)
    stated: bool = field(default=False, metadata=OMITTED)
    ahead: int | None = field(default=None, metadata=OMITTED)
    of_prediction: float | None = field(default=None, metadata=OMITTED)

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        apart = f"{abs(self.predicted - self.measured):.2g}{unit}"
        ratio = self.predicted / self.measured if self.logarithms and self.measured > 0 else 0.0
        if ratio > 0:
            larger = max(ratio, 1 / ratio)
            apart = f"{100 * abs(ratio - 1):.2g} %" if larger < 2 else f"a factor of {larger:.3g}"
        kind = "stated noise" if self.stated else "noise"
        noise = "" if self.of_noise is None else f", {self.of_noise:.2g} standard deviations of the {kind}"
        if self.of_prediction is not None:
            noise = f", {self.of_prediction:.2g} standard deviations of such predictions"
        which = "worst row" if self.ahead is None else f"worst row {self.ahead} ahead"
        return (
            f"{which}: {self.channel} of trajectory `{self.trajectory}` at {self.time:.6g}: measured "
            f"{self.measured:.4g}{unit}, predicted {self.predicted:.4g}{unit}: {apart} apart{noise}"
        )


def worst_row(run: Run, trajectories: Trajectories, predictions: Sequence[Prediction]) -> WorstRow | None:
    """The measurement with the largest error; None if there is none that could be compared. With random disturbances,
    which lead measurements away from any solution, no error is compared with the noise of measurement."""
    scales = run.fit.error_scales(run.model)
    deviation, found = error_deviations(trajectories, scales), None
    for item, one in zip(trajectories.items, predictions, strict=True):
        values, predicted = on_error_scales(scales, item.values, one.channels, item.counts)
        off = np.abs(predicted - values) / deviation
        if one.failure or not np.isfinite(off).any():
            continue
        row, column = np.unravel_index(int(np.nanargmax(off)), off.shape)
        if found is None or off[row, column] > found.deviations:
            place = (int(row), int(column))
            error = float(np.abs(predicted - values)[place])
            if scales[column].size is not None:  # told in standard deviations of the count itself
                error = float(abs(one.channels[place] - item.values[place]))
            of_noise, stated = (None, False) if run.model.diffusions else _of_noise(run, item, one, place, error)
            found = WorstRow(
                item.label,
                float(item.times[row]),
                trajectories.channels[int(column)],
                float(item.values[row, column]),
                float(one.channels[row, column]),
                float(off[row, column]),
                scales[column].logarithms,
                of_noise,
                run.model.channels[int(column)].unit or "",
                stated,
            )
    return found


def _of_noise(
    run: Run, item: Trajectory, one: Prediction, place: tuple[int, int], error: float
) -> tuple[float | None, bool]:
    """The error of a measurement, of its logarithm where the noise is log-normal, in standard deviations of its noise:
    of the one that the table states, else of the larger one of those of the fit and of the model, and whether it is the
    model's; None where there is none."""
    row, column = place
    log, channel = bool(logarithmic(run.model)[column]), run.model.channels[column]
    value, size = (abs(float(each[place])) for each in (one.channels, item.values))
    average = np.sqrt(max(float(item.counts[place]), 1.0))
    noise, own = noise_at(run, one.channels[row][None])[0, column] / average, np.isfinite(item.sd[place])
    if own:
        value, noise = size, item.sd[place]
    if log:
        noise = noise / value if value > 0 else 0.0
    known = channel.noise.scale if channel.noise is not None and channel.noise.value is None and not own else 0.0
    declared = (np.sqrt(np.log1p(known**2)) if log else known) / average
    largest = float(max(noise, declared) if np.isfinite(noise) else declared)
    return (float(error / largest) if largest > 0 else None), bool(declared > 0 and declared == largest)


def worst_ahead(
    run: Run, trajectories: Trajectories, rows: int, predictions: Sequence[tuple[Array, Array]]
) -> WorstRow | None:
    """The measurement with the largest error of predictions so many rows ahead, in their standard deviations; None if
    there is none. `predictions` has both [R, C] for the rows of each trajectory from its start on; standard deviations
    are of logarithms where the noise is log-normal, and there is no prediction (NaN) where none is so far ahead."""
    scales = run.fit.error_scales(run.model)
    deviation, found = error_deviations(trajectories, scales), None
    for item, (predicted, sd) in zip(trajectories.items, predictions, strict=True):
        here = item.times >= item.start
        measured = item.values[here]
        values, fitted = on_error_scales(scales, measured, predicted)
        error = np.abs(fitted - values)
        with np.errstate(divide="ignore", invalid="ignore"):
            off = np.where(sd > 0, error / sd, np.nan)
        if not np.isfinite(off).any():
            continue
        row, column = map(int, np.unravel_index(int(np.nanargmax(off)), off.shape))
        if found is None or off[row, column] > (found.of_prediction or 0.0):
            channel = run.model.channels[column]
            found = WorstRow(
                item.label,
                float(item.times[here][row]),
                channel.name,
                float(measured[row, column]),
                float(predicted[row, column]),
                float(error[row, column] / deviation[column]),
                scales[column].logarithms,
                unit=channel.unit or "",
                ahead=rows,
                of_prediction=float(off[row, column]),
            )
    return found
