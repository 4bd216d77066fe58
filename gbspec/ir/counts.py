"""Counts: their moments, and the quantiles of what is predicted of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gbspec.ir.noises import LEAST_COUNT, NOISES, NoiseForm

if TYPE_CHECKING:
    from gbspec.ir.model import Channel, Model


def count_moments(
    model: Model, channel: int, mean: NDArray[np.float64], constants: Mapping[str, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance [R] of the counts of a channel where it has the values `mean` [R]."""
    f = np.maximum(mean, LEAST_COUNT)
    return f, f + f * (f / count_size(model, channel, constants))


def count_size(model: Model, channel: int, constants: Mapping[str, float]) -> float:
    """The size of the negative binomial counts of a channel; infinite for Poisson's. `constants` has the values of
    learnables."""
    noise = model.channels[channel].noise
    if noise is None or noise.shape is None:
        return np.inf
    from sympy import Float

    from gbspec.ir.symbols import symbol

    known = {one.name: one.value for one in model.constants} | dict(constants)
    return float(noise.shape.xreplace({symbol(name): Float(value) for name, value in known.items()}))


def noise_form(channel: Channel) -> NoiseForm | None:
    """The kind of noise that a channel states."""
    return None if channel.noise is None else NOISES[channel.noise.kind]


def counted_channels(model: Model) -> NDArray[np.bool_]:
    """Which channels [C] are counts by their noise."""
    forms = [noise_form(c) for c in model.channels]
    return np.array([form is not None and form.counts for form in forms], dtype=np.bool_)


def count_quantile(
    probability: NDArray[np.float64] | float, mean: NDArray[np.float64], variance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The least whole number that a count lies at or below with this probability.

    Counts have the negative binomial distribution with this mean and variance, or Poisson's where the variance is not
    larger than the mean: the distribution of a Poisson count whose expectation has a gamma distribution. What is not
    known of a prediction thus adds to the variance. NaN where mean or variance is not finite.
    """
    from scipy.stats import nbinom, poisson  # not every command needs it

    p, f, v = np.broadcast_arrays(np.asarray(probability, dtype=np.float64), mean, variance)
    known = np.isfinite(f) & np.isfinite(v)
    f = np.where(known, np.maximum(f, 0.0), 0.0)
    wider = known & (f > 0) & (v > f * (1 + 1e-9))
    size = np.divide(f**2, v - f, out=np.ones_like(f), where=wider)
    out = np.array(poisson.ppf(p, f), dtype=np.float64)
    if wider.any():
        out[wider] = nbinom.ppf(p[wider], size[wider], size[wider] / (size[wider] + f[wider]))
    return np.where(known, np.maximum(out, 0.0), np.nan)
