"""Location and scale of each measured channel, by which residuals and network inputs are scaled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.data.trajectories import Trajectories
from gbspec.ir import ErrorScale, Model, logarithmic

MAD_TO_SD = 1.4826
"""The standard deviation of a normal distribution over its median absolute deviation."""
FLAT = 1e-9
"""Values whose standard deviation (or range) is below this fraction of their magnitude count as constant."""


@dataclass(frozen=True)
class ChannelStatistics:
    """Statistics of one channel's measured values: number, mean, standard deviation, extremes, median, robust scale.

    `robust_sd` is 1.4826 times the median absolute deviation: the standard deviation of normally distributed values,
    and robust against outliers. NaN where nothing was measured.
    """

    name: str
    n: int
    mean: float
    sd: float
    low: float
    high: float
    median: float
    robust_sd: float

    @property
    def scale(self) -> float:
        """A positive scale: the standard deviation, or the magnitude if the channel does not vary, or 1."""
        for candidate in (self.sd, abs(self.mean)):
            if math.isfinite(candidate) and candidate > 0:
                return candidate
        return 1.0


def channel_statistics(trajectories: Trajectories) -> tuple[ChannelStatistics, ...]:
    """The statistics of each channel, in the order of `trajectories.channels`; an average of replicates counts once."""
    if not trajectories.items:
        return tuple(_of(name, np.zeros(0)) for name in trajectories.channels)
    stacked = np.concatenate([item.values for item in trajectories.items])
    return tuple(
        _of(name, column[~np.isnan(column)]) for name, column in zip(trajectories.channels, stacked.T, strict=True)
    )


def measured_scale(values: Array) -> float:
    """A positive scale of errors: the standard deviation of the measured values (NaN left out).

    If they do not vary it is their magnitude, and 1 if that is zero or nothing was measured.
    """
    measured = values[np.isfinite(values)]
    if not measured.size:
        return 1.0
    deviation, size = float(measured.std()), float(np.abs(measured).max())
    if FLAT * size < deviation < math.inf:
        return deviation
    return size or 1.0


def channel_scales(trajectories: Trajectories) -> Array:
    """`measured_scale` of each channel [C] over all measurements of a table with at least one trajectory."""
    stacked = np.concatenate([item.values for item in trajectories.items])
    return np.array([measured_scale(column) for column in stacked.T])


def deviations(model: Model, trajectories: Trajectories) -> Array:
    """The scale of residuals without declared noise: `measured_scale` of each channel [C]; for residuals of logarithms
    that of the logarithms (1 if these do not vary)."""
    columns = np.concatenate([np.zeros((0, len(model.channels))), *(item.values for item in trajectories.items)]).T
    each = zip(columns, logarithmic(model), strict=True)
    return np.array([scale_of_logarithms(column) if log else measured_scale(column) for column, log in each])


def error_deviations(trajectories: Trajectories, scales: Sequence[ErrorScale]) -> Array:
    """The same [C] of errors: of the measured values of each channel on its scale (`gbspec.ir.error_scales`)."""
    columns = np.concatenate([np.zeros((0, len(scales))), *(item.values for item in trajectories.items)]).T
    return np.array([error_deviation(column, scale) for column, scale in zip(columns, scales, strict=True)])


def error_deviation(values: Array, scale: ErrorScale) -> float:
    """A positive scale of the errors of measured values of one channel."""
    return scale_of_logarithms(values) if scale.logarithms else measured_scale(scale.measured(values))


def scale_of_logarithms(values: Array) -> float:
    """The standard deviation of the logarithms of the measured values that have one; 1 if these do not vary."""
    logarithms = np.log(values[np.isfinite(values) & (values > 0)])
    deviation = float(logarithms.std()) if logarithms.size else 0.0
    return deviation if deviation > FLAT * float(np.abs(logarithms).max(initial=0.0)) else 1.0


def evenly_spaced(count: int, most: int) -> list[int]:
    """All of `count` positions, or `most` of them, evenly spaced from the first to the last."""
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, most))}) if count else []


def _of(name: str, values: Array) -> ChannelStatistics:
    if not len(values):
        nan = math.nan
        return ChannelStatistics(name, 0, nan, nan, nan, nan, nan, nan)
    median = float(np.median(values))
    return ChannelStatistics(
        name=name,
        n=len(values),
        mean=float(values.mean()),
        sd=float(values.std()),
        low=float(values.min()),
        high=float(values.max()),
        median=median,
        robust_sd=MAD_TO_SD * float(np.median(np.abs(values - median))),
    )
