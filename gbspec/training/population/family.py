"""What a noise with a density of its own offers to the likelihoods, one class for each kind (`families.py` lists them).

The normal and the log-normal noise are sums of squares and are part of `likelihood.py` itself.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
from torch import Tensor

from gbspec.arrays import Array


@dataclass(frozen=True)
class Rows:
    """Measured values [m] and what a model says of them: the prediction `mean`, the measured `value`, the `variance`
    (of Student's noise the square of the scale) with its derivative `slope` by the mean, the `shape` (1 where the noise
    has none), and the `number` of measurements that the value averages, which the variance contains."""

    mean: Tensor
    value: Tensor
    variance: Tensor
    slope: Tensor
    shape: Tensor
    number: Tensor

    @property
    def residual(self) -> Tensor:
        """Prediction minus value."""
        return self.mean - self.value

    def detached(self) -> Rows:
        """Without what they depend on."""
        return Rows(*(getattr(self, one.name).detach() for one in fields(self)))

    def at(self, rows: Tensor) -> Rows:
        """Some of them."""
        return Rows(*(getattr(self, one.name)[rows] for one in fields(self)))


@dataclass(frozen=True)
class Linearised:
    """The normal noise that tells as much: its `variance` [m], whose derivatives by the parameters at fixed predictions
    are `slopes` [m, P], and roots [m, P] of information that is not one of the variance (`further`)."""

    variance: Array
    slopes: Array
    further: Array


class Family(Protocol):
    """A noise with a density of its own. All of it is of values [m], elementwise; tensors can be differentiated twice
    by mean and shape."""

    def minus_two_log(self, of: Rows) -> Tensor:
        """Minus twice the logarithm of the density, or of the probability of a count."""

    def by_mean(self, of: Rows) -> Tensor:
        """The derivative of half of it by the mean, which also moves the variance."""

    def expected(self, of: Rows) -> Tensor:
        """The expected information of the mean: the expectation of the second derivative of half of it."""

    def equivalent(self, of: Rows) -> Array:
        """The variance of a normal noise with the same information of the mean."""

    def linearised(self, of: Rows, slopes: Array, of_shape: Array) -> Linearised:
        """That normal noise, with the information of the scale and the shape, whose derivatives by the parameters are
        `slopes` [m, P] (of the variance) and `of_shape` [m, P]."""

    def normal_quantile(self, of: Rows) -> Array:
        """The standard normal numbers of the same probability as the values."""

    def numbers(self, shape: Array, random: np.random.Generator) -> Array:
        """Random numbers from which `drawn` makes values; they do not depend on predictions."""

    def drawn(self, numbers: Array, mean: Array, variance: Array, number: Array) -> Array:
        """Random values [..., m] from such numbers."""
