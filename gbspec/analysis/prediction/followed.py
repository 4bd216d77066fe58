"""What is said of estimated starts from which solutions do not follow the rows that they were estimated from.

The estimate is the best of several minima of least squares; where none of them follows the rows nearly as well as the
fit follows its training data, either no guess came near the right start, or the trajectory shows what the model lacks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.noise import residual_noise
from gbspec.arrays import Array
from gbspec.files import finite
from gbspec.ir import LEAST_PREDICTED, ErrorScale, logarithmic

if TYPE_CHECKING:
    from gbspec.data import Scales, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import FitRecord

ENOUGH, FAR = 10, 4.0
"""Of at least so many values the mean square of residuals is more than so many times the square of what the fit has."""
VISIBLE = 0.05
"""Smaller residuals, in standard deviations of the data, are not worth a warning: where data are almost exact, a fit
follows its own far more closely than this, and others a little less closely."""


@dataclass(frozen=True)
class Missed:
    """A channel that a solution misses in the rows that its start was estimated from: the root mean squares of the
    residuals there, and of what is expected of them by the fit (`fitted`: the larger one of its noise and its
    residuals); of logarithms, where the noise is log-normal. `training`: that of the residuals of the training data."""

    label: str
    channel: str
    values: int
    rmse: float
    fitted: float
    logarithms: bool
    training: float | None = None

    def __str__(self) -> str:
        of = "the logarithms of " if self.logarithms else ""
        known = self.training if self.training is not None else self.fitted
        has = "the fit has" if self.training is not None else "the noise of the fit is"
        where = " in its training data" if self.training is not None else ""
        return f"rmse of {of}`{self.channel}` {self.rmse:.4g} in {self.values} values, where {has} {known:.4g}{where}"


def missed(model: Model, fit: FitRecord, scales: Scales, item: Trajectory, channels: Array) -> Missed | None:
    """The channel that the solution with `channels` [R, C] misses most in all rows of a trajectory, by what the fit
    has; None if it follows them, or if that cannot be told."""
    log, found = logarithmic(model), list[Missed]()
    noise, known = residual_noise(model, fit, channels), _errors(fit)
    for j, channel in enumerate(model.channels):
        scale = ErrorScale(bool(log[j]))
        values, predicted = scale.measured(item.values[:, j]), scale.predicted(channels[:, j], LEAST_PREDICTED)
        own = item.sd[:, j] / np.abs(item.values[:, j]) if log[j] else item.sd[:, j]
        of_average = noise[:, j] / np.sqrt(np.maximum(item.counts[:, j], 1.0))
        expected = np.fmax(of_average, own)  # that of single rows, where the table states it
        if not log[j]:
            expected = np.fmax(expected, known.get(channel.name, 0.0))
        seen = np.isfinite(values) & np.isfinite(predicted) & (expected > 0)
        if item.limits is not None:
            seen &= item.limits.side[:, j] == 0  # values beyond a limit are not missed
        count = int(seen.sum())
        if count < ENOUGH:
            continue
        residual, typical = (values - predicted)[seen], expected[seen]
        rmse = float(np.sqrt(np.mean(residual**2)))
        if np.mean((residual / typical) ** 2) > FAR and rmse > VISIBLE * scales.deviation[j]:
            fitted = float(np.sqrt(np.mean(typical**2)))
            trained = None if log[j] else finite(known.get(channel.name, np.nan))  # known of values alone
            found.append(Missed(item.label, channel.name, count, rmse, fitted, bool(log[j]), trained))
    return max(found, key=lambda one: one.rmse / one.fitted, default=None)


def _errors(fit: FitRecord) -> Mapping[str, float]:
    """The root mean square residual of each channel in the training data: the largest of the members."""
    each: dict[str, float] = {}
    for member in fit.members:
        for name, rmse in member.rmse.items():
            each[name] = max(each.get(name, 0.0), rmse if rmse is not None else np.inf)
    return each


def said_of_starts(found: Sequence[Missed | None], remedy: str) -> list[str]:
    """A warning of the trajectories that are missed in the rows of their own estimate, with the worst one's numbers."""
    each = [one for one in found if one is not None]
    if not each:
        return []
    worst = max(each, key=lambda one: one.rmse / one.fitted)
    labels = [worst.label, *(one.label for one in each if one is not worst)]
    listed = ", ".join(f"`{label}`" for label in labels[:5]) + (", ..." if len(labels) > 5 else "")
    which = (
        f"the solution of trajectory {listed} does" if len(each) == 1 else f"the solutions of trajectories {listed} do"
    )
    numbers = str(worst) if len(each) == 1 else f"`{worst.label}`: {worst}"
    return [
        f"{which} not follow the rows from which what is unknown was estimated ({numbers}). Either the data lead to "
        f"another start than the right one, or they show what the model lacks. {remedy}"
    ]
