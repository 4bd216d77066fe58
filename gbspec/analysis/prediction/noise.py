"""The measurement noise that a fit estimated, at predicted values, and the intervals that follow from it.

The noise of a lognormal channel is that of its logarithm: its standard deviation is proportional to the measured value,
and an interval extends by the same factor upwards and downwards.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import logarithmic

if TYPE_CHECKING:
    from gbspec.ir import Channel
    from gbspec.runs import Run


NORMAL_90 = 1.6448536269514722
"""Half the width of a normal distribution's 90 % interval, in standard deviations."""


def noise_at(run: Run, values: Array) -> Array:
    """The standard deviation [..., C] of a measurement of channels at `values` [..., C], in their own units: under
    Student's noise that of a normal one with the same 90 % interval."""
    found = np.array(
        [(run.fit.noise.get(c.name) or 0.0) * _wider(run, c) for c in run.model.channels], dtype=np.float64
    )
    return np.asarray(found * np.where(logarithmic(run.model), np.abs(values), 1.0), dtype=np.float64)


def _wider(run: Run, channel: Channel) -> float:
    """The 90 % interval of Student's noise, in units of that of a normal one whose standard deviation is the scale."""
    if channel.noise is None or channel.noise.freedom is None:
        return 1.0
    import sympy  # only here: `--version` and the like need neither
    from scipy.special import stdtrit

    from gbspec.ir import symbol

    known = {c.symbol: c.value for c in run.model.constants}
    known |= {symbol(name): one.value for name, one in run.fit.constants.items() if one.value is not None}
    freedom = float(channel.noise.freedom.xreplace({s: sympy.Float(v) for s, v in known.items()}))
    return float(stdtrit(freedom, 0.95)) / NORMAL_90


def interval(mean: Array, sd: Array, in_logarithms: Mask | bool) -> tuple[Array, Array]:
    """The 90 % interval around `mean`: both ends, of the same shape; multiplicative for noise of logarithms."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        factor = np.exp(NORMAL_90 * sd / np.abs(mean))
        by_factor = in_logarithms & np.isfinite(factor)
        low = np.where(by_factor, np.minimum(mean / factor, mean * factor), mean - NORMAL_90 * sd)
        high = np.where(by_factor, np.maximum(mean / factor, mean * factor), mean + NORMAL_90 * sd)
    return low, high
