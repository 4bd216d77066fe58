"""The density of Student's distribution, for measurements with outliers.

A value with the residual r, the scale s (v = s^2) and n degrees of freedom has the density

    Gamma((n + 1)/2) / (Gamma(n/2) sqrt(pi n v)) (1 + r^2/(n v))^(-(n + 1)/2).

Its expected information by (mean, log s, n) has (n + 1)/((n + 3) v) for the mean, which is independent of the others,
2 n/(n + 3) for log s, -2/((n + 1)(n + 3)) for log s with n, and for n itself

    (psi'(n/2) - psi'((n + 1)/2))/4 - (n + 5)/(2 n (n + 1)(n + 3))

(Lange, Little and Taylor, J. Am. Stat. Assoc. 84, 1989, 881).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.special import ndtri, polygamma, stdtr
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.population.family import Linearised, Rows


def minus_two_log(residual: Tensor, variance: Tensor, freedom: Tensor) -> Tensor:
    """Minus twice the logarithm of the density."""
    normed = torch.lgamma((freedom + 1) / 2) - torch.lgamma(freedom / 2)
    return (
        torch.log(torch.pi * freedom * variance)
        - 2 * normed
        + (freedom + 1) * torch.log1p(residual**2 / (freedom * variance))
    )


def by_mean(residual: Tensor, variance: Tensor, slope: Tensor, freedom: Tensor) -> Tensor:
    """The derivative of half of it by the mean, by which the variance has the derivative `slope`."""
    size = freedom * variance + residual**2
    of_scale = 0.5 * slope / variance * (1 - (freedom + 1) * residual**2 / size)
    return (freedom + 1) * residual / size + of_scale


def expected(variance: Tensor, slope: Tensor, freedom: Tensor) -> Tensor:
    """The expected information of the mean, which also moves the variance."""
    return (freedom + 1) / ((freedom + 3) * variance) + 0.5 * freedom / (freedom + 3) * (slope / variance) ** 2


def equivalent(variance: Array, freedom: Array) -> Array:
    """The variance of a normal noise with the same information of the mean."""
    return variance * (freedom + 3) / (freedom + 1)


def of_scale_and_freedom(freedom: Array) -> tuple[Array, Array, Array]:
    """The expected information of (log s, n): both diagonal entries, and the one between them."""
    n = freedom
    scale, between = 2 * n / (n + 3), -2 / ((n + 1) * (n + 3))
    own = (polygamma(1, n / 2) - polygamma(1, (n + 1) / 2)) / 4 - (n + 5) / (2 * n * (n + 1) * (n + 3))
    return scale, np.maximum(own, 0.0), between


def normal_quantile(residual: Array, freedom: Array) -> Array:
    """The standard normal number of the same probability as a residual in units of the scale."""
    lower = stdtr(freedom, -np.abs(residual))  # whose probability keeps its digits
    return np.asarray(-np.sign(residual) * ndtri(lower), dtype=np.float64)


def draw(freedom: Array, random: np.random.Generator) -> Array:
    """Drawn residuals in units of the scale."""
    return np.asarray(random.standard_t(freedom), dtype=np.float64)


class Student:
    """The family (`family.Family`): an average of n values has the scale over the root of n, as an approximation."""

    def minus_two_log(self, of: Rows) -> Tensor:
        """Minus twice the logarithm of the density."""
        return minus_two_log(of.residual, of.variance, of.shape)

    def by_mean(self, of: Rows) -> Tensor:
        """The derivative of half of it by the mean."""
        return by_mean(of.residual, of.variance, of.slope, of.shape)

    def expected(self, of: Rows) -> Tensor:
        """The expected information of the mean."""
        return expected(of.variance, of.slope, of.shape)

    def equivalent(self, of: Rows) -> Array:
        """The variance of a normal noise with the same information of the mean."""
        return equivalent(of.variance.numpy(), of.shape.numpy())

    def linearised(self, of: Rows, slopes: Array, of_shape: Array) -> Linearised:
        """The normal noise with the same information of the mean and of the scale; what the degrees of freedom tell
        beyond the scale is the further information."""
        variance, freedom = of.variance.numpy(), of.shape.numpy()
        scale, own, between = of_scale_and_freedom(freedom)
        same = equivalent(variance, freedom)
        moved = 0.5 * slopes / variance[:, None] + (between / scale)[:, None] * of_shape
        relative = np.sqrt(2 * scale)[:, None] * moved
        further = np.sqrt(np.maximum(own - between**2 / scale, 0.0))[:, None] * of_shape
        return Linearised(same, same[:, None] * relative, further)

    def normal_quantile(self, of: Rows) -> Array:
        """The standard normal numbers of the same probability as the values."""
        return normal_quantile(-of.residual.numpy() / np.sqrt(of.variance.numpy()), of.shape.numpy())

    def numbers(self, shape: Array, random: np.random.Generator) -> Array:
        """Drawn residuals in units of the scale."""
        return draw(shape, random)

    def drawn(self, numbers: Array, mean: Array, variance: Array, number: Array) -> Array:
        """Random values from these."""
        return np.asarray(mean + np.sqrt(variance) * numbers, dtype=np.float64)
