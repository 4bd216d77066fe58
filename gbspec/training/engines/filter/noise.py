"""The variances of measurements: stated ones, those of the table, and learned ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import logarithmic
from gbspec.training.problem import Integers, Problem

LEAST = 1e-6
"""The smallest standard deviation of a measurement that is learned, in standard deviations of the channel's data."""
FIRST = 0.1
"""The first value of a learned one, in the same unit."""


@dataclass(frozen=True)
class Noise:
    """The measurements of a problem as the filter takes them: `value` and stated variances `fixed` [R, C] (0 where they
    are learned), in units of logarithms where `log` [C].

    `column` [C] is the place of a channel's standard deviation among the learned ones (-1: stated); a learned variance
    is divided by the number of measurements that a value averages, `counts` [R, C]. `unit` [C] is the standard
    deviation of the channel's data.
    """

    value: Array
    fixed: Array
    counts: Array
    log: Mask
    column: Integers
    unit: Array

    @property
    def learned(self) -> Integers:
        """The channels whose standard deviation is learned."""
        return np.flatnonzero(self.column >= 0).astype(np.int64)

    def first(self) -> Array:
        """The first values of the learned standard deviations, as logarithms."""
        return np.asarray(np.log(FIRST * self.unit[self.learned]), dtype=np.float64)

    def least(self) -> Array:
        """Their smallest values."""
        return np.asarray(np.log(LEAST * self.unit[self.learned]), dtype=np.float64)

    def variances(self, log_sd: Array) -> Array:
        """The variances [R, C] with these learned standard deviations."""
        out = self.fixed.copy()
        for place, channel in enumerate(self.learned):
            mine = self.fixed[:, channel] <= 0
            out[mine, channel] = np.exp(2 * log_sd[place]) / self.counts[mine, channel]
        return out

    def slopes(self, variances: Array) -> Array:
        """Their derivatives [R, C, learned] in the logarithms of the learned standard deviations."""
        out = np.zeros((*variances.shape, len(self.learned)))
        for place, channel in enumerate(self.learned):
            mine = self.fixed[:, channel] <= 0
            out[mine, channel, place] = 2 * variances[mine, channel]
        return out


def noise_of(problem: Problem) -> Noise:
    """The measurements of a problem; a channel without a stated noise that has no column of standard deviations for
    all its values gets a learned one."""
    model, packed, seen = problem.model, problem.packed, problem.valued
    log = logarithmic(model)
    value = np.where(seen, packed.values, 1.0)
    counts = np.where(seen, np.maximum(packed.weights, 1e-300) ** 2, 1.0)
    own = np.isfinite(packed.sd) & (packed.sd > 0) & seen
    size = np.where(log, np.maximum(np.abs(value), 1e-300), 1.0)
    fixed = np.where(own, np.where(own, packed.sd, 1.0) / size, 0.0) ** 2
    column, place = np.full(len(model.channels), -1, dtype=np.int64), 0
    unit = np.ones(len(model.channels))
    for i, channel in enumerate(model.channels):
        mine = seen[:, i]
        if mine.any():
            data = np.log(np.maximum(value[mine, i], 1e-300)) if log[i] else value[mine, i]
            spread = float(np.std(data)) if len(data) > 1 else 0.0
            unit[i] = spread or float(np.abs(data).max()) or 1.0
        if channel.noise is not None and channel.noise.scale > 0:
            scale = channel.noise.scale
            stated = np.log1p(scale**2) if log[i] else scale**2
            fixed[:, i] = np.where(own[:, i], fixed[:, i], stated)
        elif (mine & ~own[:, i]).any():
            column[i], place = place, place + 1
    fixed = np.where(seen, fixed / counts, 0.0)
    table = np.where(log, np.log(np.maximum(np.where(seen, value, 1.0), 1e-300)), value)
    return Noise(table, fixed, counts, log, column, unit)
