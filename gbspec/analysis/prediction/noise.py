"""The noise of measurement that a fit found, at predicted values, and the intervals that follow from it.

A channel with lognormal noise has it in its logarithms: there the deviation is in proportion to what is measured, and
an interval reaches as far by a factor upwards as downwards.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import logarithmic

if TYPE_CHECKING:
    from gbspec.runs import Run


NORMAL_90 = 1.6448536269514722
"""Half of the width of a normal distribution's 90 % interval, in standard deviations."""


def noise_at(run: Run, values: Array) -> Array:
    """The standard deviation [..., C] of a measurement of channels at `values` [..., C], in their own units."""
    found = np.array([run.fit.noise.get(c.name) or 0.0 for c in run.model.channels], dtype=np.float64)
    return np.asarray(found * np.where(logarithmic(run.model), np.abs(values), 1.0), dtype=np.float64)


def interval(mean: Array, sd: Array, in_logarithms: Mask | bool) -> tuple[Array, Array]:
    """The 90 % interval around `mean`: both ends, of the same shape; by a factor where the noise is of logarithms."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factor = np.exp(NORMAL_90 * sd / np.abs(mean))
        by_factor = in_logarithms & np.isfinite(factor)
        low = np.where(by_factor, np.minimum(mean / factor, mean * factor), mean - NORMAL_90 * sd)
        high = np.where(by_factor, np.maximum(mean / factor, mean * factor), mean + NORMAL_90 * sd)
    return low, high
