"""The residual of a measured value, which fits make small and figures show.

    r = w (p - y) / s                                a channel with normal noise, or with none stated
    r = w l(p / |y|) / s                             a channel with log-normal noise
    l(q) = ln(max(q, f)) + (q - max(q, f)) / f       f = 1e-3

with the predicted value p, the measured value y, the scale s, and the weight w: the square root of the number of
measurements that y averages. l is the logarithm, continued by its tangent below f, so that a prediction that is not
positive has a residual too, one that tells which way is better. s is in the channel's unit; under log-normal noise it
is the deviation of logarithms, without a unit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gbspec.data.trajectories import Array, Trajectories
from gbspec.ir.model import Model

LOG_FLOOR = 1e-3
"""Predicted over measured: below this the logarithm is continued by its tangent."""
FLAT = 1e-9
"""A channel whose values vary by less than this part of their size counts as constant."""


def residuals(predicted: ArrayLike, measured: ArrayLike, scale: ArrayLike, logarithmic: ArrayLike) -> Array:
    """Residuals of values, all broadcast against each other; NaN where a value was not measured or predicted.

    `scale` is s / w of the module's text; `logarithmic` says where the residual is that of logarithms.
    """
    p, y = np.broadcast_arrays(np.asarray(predicted, dtype=np.float64), np.asarray(measured, dtype=np.float64))
    difference, log = np.asarray(p - y), np.broadcast_to(logarithmic, p.shape)
    if log.any():
        ratio = p[log] / np.maximum(np.abs(y[log]), 1e-300)
        safe = np.maximum(ratio, LOG_FLOOR)
        difference[log] = np.log(safe) + (ratio - safe) / LOG_FLOOR
    return np.asarray(difference / scale, dtype=np.float64)


def logarithmic(model: Model) -> NDArray[np.bool_]:
    """Which channels [C] have residuals of logarithms."""
    return np.array([c.noise is not None and c.noise.kind == "lognormal" for c in model.channels], dtype=np.bool_)


def deviations(model: Model, trajectories: Trajectories) -> Array:
    """The standard deviation [C] of each channel's data, of their logarithms where its residuals are of logarithms.

    The size of values that do not vary; 1 where that is nothing, or logarithms do not vary, or nothing was measured.
    """
    columns = np.concatenate([np.zeros((0, len(model.channels))), *(item.values for item in trajectories.items)]).T
    return np.array([_deviation(column, log) for column, log in zip(columns, logarithmic(model), strict=True)])


def _deviation(column: Array, log: bool) -> float:
    values = column[np.isfinite(column)]
    if log:
        values = np.log(values[values > 0])
    if not len(values):
        return 1.0
    deviation, size = float(values.std()), float(np.abs(values).max())
    if deviation > FLAT * size:
        return deviation
    return size if size > 0 and not log else 1.0
