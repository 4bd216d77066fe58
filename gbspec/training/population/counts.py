"""Counts: Poisson's distribution, and the negative binomial one, whose expectation has a gamma distribution besides.

With the prediction f and the size k a count y has the probabilities

    Poisson             exp(-f) f^y / y!,                                                        variance f,
    negative binomial   Gamma(y + k)/(Gamma(k) y!) (k/(k + f))^k (f/(k + f))^y,                  variance f + f^2/k.

The sum of n counts is one with n f and n k; an average of n is taken as this sum. For both the derivative of -log p by
f is (f - y)/v with the variance v, and the expected information of f is 1/v. That of k is

    I_kk = sum over j >= 0 of P(Y > j)/(k + j)^2 - f/(k (k + f)),

and between f and k there is none (Lawless, Can. J. Stat. 15, 1987, 209).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from scipy.special import betainc, ndtri
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import LEAST_COUNT, count_quantile
from gbspec.training.population.family import Linearised, Rows

LARGE = 1e3
"""From this size on, differences of log Gamma come from Stirling's series, which keeps the digits of their limit."""
SINGLE = 256
"""So many terms of the information's sum are added one by one; the rest is an integral by Gauss and Legendre."""
NODES = 64
FARTHEST = 12.0
"""The sum ends so many standard deviations, and as many units, above the mean."""
LOGARITHMS = (-7.0, 14.0)
"""The logarithms of a size that a fit begins with."""
UNTOLD = 1e100
"""The variance of what tells nothing."""
ALIKE = 400
"""Beyond so many values of one size the information is interpolated between this many expectations."""


class _Counts:
    """What both have in common: the score and the information of the mean are those of a quasi-likelihood (McCullagh
    and Nelder, Generalized Linear Models, 1989, 9.2)."""

    def by_mean(self, of: Rows) -> Tensor:
        """The derivative of -log p by the mean."""
        return torch.where(of.mean > LEAST_COUNT, of.residual / of.variance, torch.zeros_like(of.mean))

    def expected(self, of: Rows) -> Tensor:
        """The expected information of the mean."""
        return torch.where(of.mean > LEAST_COUNT, 1 / of.variance, torch.zeros_like(of.mean))

    def equivalent(self, of: Rows) -> Array:
        """The variance."""
        return np.asarray(of.variance.numpy(), dtype=np.float64)

    def normal_quantile(self, of: Rows) -> Array:
        """The standard normal numbers of the probability of less than a count and half of that of the count itself."""
        below, at = self._probabilities(of)
        smallest = np.finfo(np.float64).tiny
        return np.asarray(ndtri(np.clip(below - at / 2, smallest, 1 - 2**-53)), dtype=np.float64)

    def numbers(self, shape: Array, random: np.random.Generator) -> Array:
        """Uniform numbers from 0 to 1."""
        return np.asarray(random.random(shape.shape), dtype=np.float64)

    def drawn(self, numbers: Array, mean: Array, variance: Array, number: Array) -> Array:
        """The counts of these probabilities, divided by the number of those that are averaged."""
        return np.asarray(count_quantile(numbers, mean * number, variance * number**2) / number, dtype=np.float64)

    def _probabilities(self, of: Rows) -> tuple[Array, Array]:
        """P(Y <= y) and P(Y = y)."""
        raise NotImplementedError


class Poisson(_Counts):
    """The family of `noise poisson`."""

    def minus_two_log(self, of: Rows) -> Tensor:
        """Minus twice the logarithm of the probability."""
        total, mean = _sums(of)
        return 2 * (mean - total * torch.log(mean) + torch.lgamma(total + 1))

    def linearised(self, of: Rows, slopes: Array, of_shape: Array) -> Linearised:
        """The variance tells nothing beyond the mean."""
        return Linearised(_told(of), np.zeros_like(slopes), np.zeros_like(slopes))

    def _probabilities(self, of: Rows) -> tuple[Array, Array]:
        from scipy.stats import poisson  # not at the top: every process of a fit would import it

        total, mean = (part.numpy() for part in _sums(of))
        return poisson.cdf(total, mean), poisson.pmf(total, mean)


class NegativeBinomial(_Counts):
    """The family of `noise negative_binomial(k)`."""

    def minus_two_log(self, of: Rows) -> Tensor:
        """Minus twice the logarithm of the probability."""
        total, mean = _sums(of)
        size = of.shape * of.number
        return 2 * (
            torch.lgamma(total + 1)
            - _rising(total, size)
            + (size + total) * torch.log1p(mean / size)
            - total * torch.log(mean)
        )

    def linearised(self, of: Rows, slopes: Array, of_shape: Array) -> Linearised:
        """The size has the further information I_kk; it is independent of the mean."""
        mean, size, number = of.mean.numpy(), of.shape.numpy(), of.number.numpy()
        own = number**2 * size_information(mean * number, size * number)
        return Linearised(_told(of), np.zeros_like(slopes), np.sqrt(own)[:, None] * of_shape)

    def _probabilities(self, of: Rows) -> tuple[Array, Array]:
        from scipy.stats import nbinom  # not at the top: every process of a fit would import it

        total, mean = (part.numpy() for part in _sums(of))
        size = (of.shape * of.number).numpy()
        return nbinom.cdf(total, size, size / (size + mean)), nbinom.pmf(total, size, size / (size + mean))


def _sums(of: Rows) -> tuple[Tensor, Tensor]:
    """The sum of the counts that each value averages, and its expectation."""
    return torch.round(of.value * of.number), torch.clamp(of.mean, min=LEAST_COUNT) * of.number


def _told(of: Rows) -> Array:
    """The variance of the counts; where the model has none, and nothing moves its mean, one so large that they tell
    nothing."""
    return np.asarray(np.where(of.mean.numpy() > LEAST_COUNT, of.variance.numpy(), UNTOLD), dtype=np.float64)


def _rising(y: Tensor, k: Tensor) -> Tensor:
    """log Gamma(y + k) - log Gamma(k) - y log k."""
    large = k > LARGE
    small, big = torch.where(large, torch.ones_like(k), k), torch.where(large, k, torch.full_like(k, LARGE))
    exact = torch.lgamma(y + small) - torch.lgamma(small) - y * torch.log(small)
    series = (big + y - 0.5) * torch.log1p(y / big) - y + _stirling(big + y) - _stirling(big)
    return torch.where(large, series, exact)


def _stirling(z: Tensor) -> Tensor:
    """The rest of Stirling's formula, to 1e-18 from `LARGE` on."""
    return 1 / (12 * z) - 1 / (360 * z**3)


def size_information(mean: Array, size: Array) -> Array:
    """The expected information of the size of a count [m], by its own value: I_kk above. 0 where the mean is 0."""
    mean = np.where(np.isfinite(mean), mean, 0.0)
    out = np.zeros(len(mean))
    for k in np.unique(size[np.isfinite(size)]):
        rows = np.flatnonzero((size == k) & (mean > LEAST_COUNT))
        if len(rows) <= ALIKE:
            out[rows] = _size_information(mean[rows], float(k))
            continue
        logs = np.log(mean[rows])
        grid = np.linspace(logs.min(), logs.max(), ALIKE)
        known = np.log(np.maximum(_size_information(np.exp(grid), float(k)), np.finfo(np.float64).tiny))
        out[rows] = np.exp(np.interp(logs, grid, known))
    return out


def _size_information(mean: Array, k: float) -> Array:
    """The same for one size: the sum of its first terms, and of the rest the integral from half a step before, with the
    first correction of Euler and Maclaurin."""

    def term(j: Array, f: Array) -> Array:
        return np.asarray(betainc(j + 1, k, f / (k + f)) / (k + j) ** 2, dtype=np.float64)  # P(Y > j)/(k + j)^2

    f = mean[:, None]
    last = mean + FARTHEST * (np.sqrt(mean + mean**2 / k) + 1)
    first = np.arange(min(SINGLE, int(np.max(last, initial=0.0)) + 1), dtype=np.float64)
    total = term(first, f).sum(axis=1)
    far = np.flatnonzero(last > SINGLE)
    if len(far):
        x, weight = np.polynomial.legendre.leggauss(NODES)
        begin, high = SINGLE - 0.5 + 0 * f[far], f[far]
        # P is nearly constant up to where counts are: one interval before, and two around the mean, in log(k + j).
        width = FARTHEST * np.sqrt(high + high**2 / k)
        ends = np.hstack([begin, high - width, high, high + width])
        edges = np.log(k + np.sort(np.maximum(ends, begin), axis=1))
        for a, b in zip(edges.T[:-1], edges.T[1:], strict=True):
            at = np.exp((a + b)[:, None] / 2 + (b - a)[:, None] / 2 * x)
            total[far] += (at * term(at - k, high) * weight).sum(axis=1) * (b - a) / 2
        total[far] += (term(begin + 0.5, high) - term(begin - 0.5, high))[:, 0] / 24
    return np.asarray(np.maximum(total - mean / (k * (k + mean)), 0.0), dtype=np.float64)


def likeliest_size(counts: Array, mean: Array, number: Array) -> float:
    """The size at which averages `counts` [m] of `number` [m] negative binomial counts with expectations `mean` [m] are
    likeliest; a mean below 0 counts as none."""
    known = np.isfinite(mean)
    n = torch.from_numpy(number[known])
    total, expected = (
        torch.from_numpy(counts[known]) * n,
        torch.clamp(torch.from_numpy(mean[known]), min=LEAST_COUNT) * n,
    )

    def minus_log(logarithm: float) -> float:
        size = np.exp(logarithm) * n
        return float(((size + total) * torch.log1p(expected / size) - _rising(total, size)).sum())

    return float(np.exp(minimize_scalar(minus_log, bounds=LOGARITHMS, method="bounded").x))
