"""The steps in which sub-steps are taken where they follow a tolerance, as shares of a sub-step.

The likelihood is a smooth function of its vector only while the steps stay. So they are part of what a filter has
found: they are chosen at one vector, and divided further at others only where the error there is beyond the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.engines.filter.sigma import LEAST
from gbspec.training.problem import Control, Integers

LOOSE = 100.0
"""Errors of means and of covariances count by the spread of the state with this many times the tolerance: what a
thousandth of a spread changes in the likelihood of a value is little beside what the value says."""
ORDER = 2
"""The order of covariances in the length of a step."""
NEAR, SHARE = 0.1, 1e-3
"""Moments are near each other where they differ by so much of the spread; it counts as at least so much of the typical
size."""
SAFETY, PIECES, MOST = 1.25, 8, 256
"""The factor on the number of pieces that the error estimate asks for, their largest number in one round, and the most
steps in a sub-step: one that needs more has no solution."""


@dataclass(frozen=True)
class Tolerance:
    """The tolerance of the error of a step: relative to the sizes of coordinates, with a share of the typical ones
    `scale` [n]; of logarithms and logits (`bent` [n]) absolute; and relative to their spreads."""

    control: Control
    scale: Array
    bent: Mask

    def error(self, means: tuple[Array, Array, Array], covs: tuple[Array, Array]) -> Array:
        """The errors [b] of steps, in units of the tolerance, from the means [b, n] before them and after one step and
        two halves of it, and the covariances [b, n, n] after these; infinite where they are not numbers."""
        before, one, two = means
        variance = np.diagonal(covs[1], axis1=1, axis2=2)
        sd = np.sqrt(np.maximum(variance, 0.0) + LEAST * self.scale**2)
        size = np.where(self.bent, 1.0, np.maximum(np.abs(before), np.abs(two)) + self.control.floor)
        of_mean = (np.abs(two - one) / (size + LOOSE * sd)).max(axis=1)
        of_cov = (np.abs(covs[1] - covs[0]) / (sd[:, :, None] * sd[:, None])).max(axis=(1, 2))
        error = np.maximum(of_mean, of_cov / LOOSE) / self.control.rtol
        return np.where(np.isfinite(error), error, np.inf)


@dataclass(frozen=True)
class Looked:
    """The moments at the starts of legs, means [B, n] and covariances [B, n, n], at which their steps had errors within
    the tolerance; infinite where they had not."""

    mean: Array
    cov: Array

    @classmethod
    def at_none(cls, legs: int, n: int) -> Looked:
        """Nothing has been looked at."""
        return cls(np.full((legs, n), np.inf), np.full((legs, n, n), np.inf))

    def due(self, mean: Array, cov: Array, least: Array) -> Mask:
        """Which legs [B] are to be looked at, since these moments are not near those; spreads count as `least` [n]."""
        sd = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0)) + least
        moved = np.abs(mean - self.mean) > NEAR * sd
        spread = np.abs(cov - self.cov) > NEAR * sd[:, :, None] * sd[:, None]
        return np.asarray(moved.any(axis=1) | spread.any(axis=(1, 2)), dtype=np.bool_)

    def put(self, legs: Integers, mean: Array, cov: Array) -> None:
        """The steps of some legs are good enough."""
        self.mean[legs], self.cov[legs] = mean, cov


def refined(shares: Array, errors: Array) -> Array:
    """Steps [b, K'] whose errors will be within the tolerance, from those [b, K] that had these errors; the same ones
    where they are, or where more than `MOST` would be needed."""
    with np.errstate(invalid="ignore"):
        wanted = np.ceil(SAFETY * np.minimum(errors, 1e9) ** (1 / (ORDER + 1)))
    pieces = np.where(errors > 1, np.clip(wanted, 2, PIECES), 1).astype(np.int64)
    pieces = np.where(shares > 0, pieces, 0)
    count = pieces.sum(axis=1)
    pieces = np.where((count > MOST)[:, None], shares > 0, pieces)
    count = pieces.sum(axis=1)
    out = np.zeros((len(shares), int(count.max(initial=1))))
    leg = np.repeat(np.arange(len(shares)), count)
    place = np.arange(len(leg)) - np.repeat(np.cumsum(count) - count, count)
    out[leg, place] = np.repeat((shares / np.maximum(pieces, 1)).ravel(), pieces.ravel())
    return out


def trimmed(shares: Array) -> Array:
    """A table of steps without places that none of them has."""
    return shares[:, : max(int((shares > 0).sum(axis=1).max(initial=1)), 1)]


def joined(shares: Array, which: Integers, new: Array) -> Array:
    """A table of steps with some rows replaced."""
    width = max(shares.shape[1], new.shape[1])
    out = np.pad(shares, ((0, 0), (0, width - shares.shape[1])))
    out[which] = np.pad(new, ((0, 0), (0, width - new.shape[1])))
    return out
