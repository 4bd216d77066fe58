"""Counts: their standard deviation in a model, and the quantiles of what is predicted of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import sympy
from numpy.typing import NDArray

from gbspec.ir.distributions import PREDICTION, Expr
from gbspec.ir.noises import NOISES, NoiseForm
from gbspec.ir.symbols import symbol

if TYPE_CHECKING:
    from gbspec.ir.model import Channel, Model

LEAST_COUNT = 1e-30
"""The expectation of a count is at least this: a count where the model has none is improbable, but not impossible."""


def deviation_of_counts(size: Expr | None) -> Expr:
    """The standard deviation by PREDICTION: of Poisson counts, or of negative binomial ones of this size."""
    mean = sympy.Max(PREDICTION, sympy.Float(LEAST_COUNT))
    return sympy.sqrt(mean if size is None else mean + mean**2 / size)


def count_moments(
    model: Model, channel: int, mean: NDArray[np.float64], constants: Mapping[str, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and variance [R] of the counts of a channel where it has the values `mean` [R]."""
    noise = model.channels[channel].noise
    f = np.maximum(mean, LEAST_COUNT)
    if noise is None or noise.shape is None:
        return f, f
    size = float(noise.shape.xreplace({symbol(name): sympy.Float(value) for name, value in constants.items()}))
    return f, f + f**2 / size


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
