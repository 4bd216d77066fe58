"""Tests of standardised innovations, which are independent standard normal numbers if model and noises are right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, kolmogorov

from gbspec.arrays import Array

LAGS = 20
"""The most lags of the Ljung-Box statistic; at most a fifth of the values."""
LEAST = 8
"""With fewer values nothing is tested."""


@dataclass(frozen=True)
class Whiteness:
    """The autocorrelations of a series [lags], with the Ljung-Box statistic and its probability, and the cumulated
    periodogram [frequencies] with its largest distance from the diagonal and the probability of this distance (that of
    Kolmogorov and Smirnov). `robust_p` is the probability of the statistic where the variance changes in time (Diebold
    1986): uncorrelated values whose squares are correlated have larger autocorrelations than independent ones."""

    values: int
    autocorrelations: Array
    ljung_box: float
    p: float
    robust_p: float
    cumulated: Array
    distance: float
    distance_p: float


def whiteness(series: list[Array]) -> Whiteness | None:
    """The tests of one channel's series in several trajectories, taken together; None if there are too few values."""
    usable = [s[np.isfinite(s)] for s in series]
    usable = [s for s in usable if len(s) >= LEAST]
    count = sum(len(s) for s in usable)
    if not usable:
        return None
    lags = int(max(1, min(LAGS, max(len(s) for s in usable) // 5)))
    squares = sum(float(s @ s) for s in usable)
    r = np.array([sum(float(s[k:] @ s[:-k]) for s in usable if len(s) > k) for k in range(1, lags + 1)])
    pairs = np.array([sum(max(len(s) - k, 0) for s in usable) for k in range(1, lags + 1)])
    r = r / squares if squares > 0 else r * np.nan
    terms = count * (count + 2) * r**2 / np.maximum(pairs, 1)
    statistic, robust = float(np.sum(terms)), float(np.sum(terms * _shares(usable, lags)))
    p, robust_p = (float(chdtrc(lags, value)) for value in (statistic, robust))
    cumulated = _cumulated(usable)
    distance, probability = _distance(cumulated)
    return Whiteness(count, r, statistic, p, robust_p, cumulated, distance, probability)


def _shares(series: list[Array], lags: int) -> Array:
    """What independent values of the same variance would have of the variance of each autocorrelation [lags]: s⁴ over
    s⁴ + the autocovariance of the squares."""
    count = sum(len(s) for s in series)
    variance = sum(float(s @ s) for s in series) / count
    squares = [s**2 - variance for s in series]
    covariance = np.array([sum(float(q[k:] @ q[:-k]) for q in squares if len(q) > k) for k in range(1, lags + 1)])
    # A negative covariance would raise the statistic, by what few values show of it.
    return np.asarray(variance**2 / (variance**2 + np.maximum(covariance / count, 0.0)), dtype=np.float64)


def _cumulated(series: list[Array]) -> Array:
    """The periodograms cumulated over common frequencies (those of the longest series), at most 1."""
    longest = max(len(s) for s in series) // 2
    frequencies, powers = [], []
    for s in series:
        half = (len(s) - 1) // 2
        power = np.abs(np.fft.rfft(s - s.mean())[1 : half + 1]) ** 2 / len(s)
        frequencies.append(np.arange(1, half + 1) / len(s))
        powers.append(power)
    at, power = np.concatenate(frequencies), np.concatenate(powers)
    order = np.argsort(at, kind="stable")
    total = np.cumsum(power[order])
    if not len(total) or not total[-1] > 0:
        return np.zeros(0)
    grid = np.linspace(0, len(total) - 1, min(len(total), max(longest, 2))).astype(np.int64)
    return np.asarray((total / total[-1])[grid], dtype=np.float64)


def _distance(cumulated: Array) -> tuple[float, float]:
    m = len(cumulated)
    if m < LEAST // 2:
        return float("nan"), float("nan")
    diagonal = np.arange(1, m + 1) / m
    distance = float(np.max(np.abs(cumulated - diagonal)))
    return distance, float(kolmogorov(distance * np.sqrt(m - 1)))
