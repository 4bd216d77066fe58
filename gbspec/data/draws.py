"""Draws of constants over their whole ranges, on the scales that their bounds suggest."""

from __future__ import annotations

import math

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Learnable

DECADES = 4.0
"""A linear range that touches 0 is also drawn from on a scale of logarithms, over this many decades below its end."""
SPREAD = 0.7
"""Without two bounds, half of the draws of a positive constant are within a factor of 10^(1.1 SPREAD) of its start."""
MARGIN = 5e-3
"""Draws stay off the ends of the unit interval, where quantiles are infinite."""


def sobol(count: int, size: int, seed: int) -> Array:
    """`count` scrambled points [count, size] of the unit cube, evenly spread (Sobol)."""
    from scipy.stats import qmc

    if size == 0:
        return np.zeros((count, 0))
    points = qmc.Sobol(size, seed=np.random.default_rng([seed, 71])).random_base2(max(count - 1, 1).bit_length())
    return np.asarray(points[:count], dtype=np.float64)


def spread_over_ranges(learnables: tuple[Learnable, ...], points: Array) -> Array:
    """Natural values [count, n] of points [count, n] of the unit cube."""
    out = np.empty_like(points)
    for i, learnable in enumerate(learnables):
        values = _quantiles(learnable, MARGIN + (1 - 2 * MARGIN) * points[:, i])
        out[:, i] = np.clip(values, learnable.range.low, learnable.range.high)
    return out


def _quantiles(learnable: Learnable, q: Array) -> Array:
    """The values of a constant at quantiles."""
    bounds, low, high, start = learnable.range, learnable.range.low, learnable.range.high, learnable.start
    unit = abs(start) or 1.0
    if learnable.prior is not None:
        return _of_prior(learnable, q)
    if bounds.logarithmic:
        return np.asarray(low * (high / low) ** q, dtype=np.float64)
    if bounds.bounded:
        # One half of the draws is uniform; the other one covers orders of magnitude, seen from 0 or from the start.
        inner = np.where(q < 0.5, 2 * q, 2 * q - 1)
        return np.where(q < 0.5, low + (high - low) * inner, _magnitudes(learnable, inner))
    if math.isfinite(low):
        return np.asarray(low + unit * _factor(q), dtype=np.float64)
    if math.isfinite(high):
        return np.asarray(high - unit * _factor(q), dtype=np.float64)
    return np.asarray(start + unit * np.tan(np.pi * (q - 0.5)), dtype=np.float64)


def _factor(q: Array) -> Array:
    """Factors around 1: logistic on a scale of logarithms."""
    return np.asarray(10.0 ** (SPREAD * np.log(q / (1 - q))), dtype=np.float64)


def _magnitudes(learnable: Learnable, q: Array) -> Array:
    """Values of many orders of magnitude in a linear range: from an end that is 0, else around the start."""
    low, high, start = learnable.range.low, learnable.range.high, learnable.start
    if low == 0:
        lowest = min(10**-DECADES, 0.01 * max(start / high, 1e-12))
        return np.asarray(high * lowest ** (1 - q), dtype=np.float64)
    if high == 0:
        lowest = min(10**-DECADES, 0.01 * max(start / low, 1e-12))
        return np.asarray(low * lowest**q, dtype=np.float64)
    unit = min(abs(start) or 1.0, 0.25 * (high - low))
    return np.asarray(start + unit * np.tan(np.pi * (q - 0.5)), dtype=np.float64)


def _of_prior(learnable: Learnable, q: Array) -> Array:
    """Quantiles of a constant's prior."""
    from scipy.special import ndtri

    prior = learnable.prior
    assert prior is not None
    if prior.kind == "normal":
        return np.asarray(prior.location + prior.scale * ndtri(q), dtype=np.float64)
    deviation = math.sqrt(math.log1p(prior.scale**2))
    return np.asarray(prior.location * np.exp(deviation * ndtri(q)), dtype=np.float64)
