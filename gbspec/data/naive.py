"""Predictors that know no model, as a scale for the errors of solutions: an average, the first value, a straight line.

Each predictor is computed for every trajectory from its own measurements; the error is that of a least-squares fit,
corrected for the number of fitted parameters (n / (n - k)).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.data.trajectories import Trajectories
from gbspec.ir import ErrorScale, Model

Predictor = Callable[[Array, Array], Array]


def _mean(t: Array, y: Array) -> Array:
    return np.full_like(y, y.mean())


def _first(t: Array, y: Array) -> Array:
    return np.full_like(y, y[0])


def _trend(t: Array, y: Array) -> Array:
    centred = t - t.mean()
    return np.asarray(y.mean() + centred * (centred @ y) / max(float(centred @ centred), 1e-300))


LINE = "a straight line through each trajectory"
"""The name of the predictor that some models are themselves."""
PREDICTORS: Mapping[str, tuple[Predictor, int]] = {
    "the mean of each trajectory": (_mean, 1),
    "the first value of each trajectory": (_first, 1),
    LINE: (_trend, 2),
}
"""The predictors and their numbers of parameters."""


@dataclass(frozen=True)
class Naive:
    """The best naive predictor of a channel, and its R²: 1 minus its mean squared error over the channel's variance."""

    predictor: str
    r2: float


def naive_predictors(model: Model, trajectories: Trajectories, scales: Sequence[ErrorScale]) -> dict[str, Naive]:
    """The best naive predictor of each channel, of values on its scale of errors (`gbspec.ir.error_scales`); none for a
    channel that does not vary."""
    out = {}
    for index, channel in enumerate(model.channels):
        series = [_series(item.times, item.values[:, index], scales[index]) for item in trajectories.items]
        variance = variance_of([y for _, y in series])
        if variance > 0:
            errors = {name: _error(series, *known) for name, known in PREDICTORS.items()}
            best = min(errors, key=lambda name: errors[name])
            out[channel.name] = Naive(best, 1 - errors[best] / variance)
    return out


def variance_of(values: list[Array]) -> float:
    """The variance of all values together; 0 if there are fewer than two, or if they do not vary."""
    joined = np.concatenate([np.zeros(0), *values])
    varies = len(joined) > 1 and float(np.ptp(joined)) > 1e-9 * float(np.abs(joined).max())
    return float(joined.var()) if varies else 0.0


def _series(t: Array, y: Array, scale: ErrorScale) -> tuple[Array, Array]:
    """Times and values of the measurements of a channel in a trajectory, those that the scale has."""
    values = scale.measured(y)
    seen = np.isfinite(values)
    return t[seen], values[seen]


def _error(series: list[tuple[Array, Array]], predictor: Predictor, parameters: int) -> float:
    """The mean squared error of a predictor; infinite if it has as many parameters as there are values."""
    squares, count, fitted = 0.0, 0, 0
    for t, y in series:
        if len(y):
            squares += float(np.sum((predictor(t, y) - y) ** 2))
            count, fitted = count + len(y), fitted + parameters
    return squares / (count - fitted) if count > fitted else float("inf")
