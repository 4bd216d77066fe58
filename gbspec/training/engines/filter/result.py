"""What a filter has found: moments at all legs, innovations, and the likelihood with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.engines.filter.division import joined
from gbspec.training.engines.filter.layout import Layout
from gbspec.training.engines.filter.recursion import Innovations, Kept, Moment
from gbspec.training.problem import Integers

Guess = tuple[Array, Array, Array, Array, Array]
"""Means [B, n] and covariances [B, n, n] at the starts of legs, those at their ends, and the steps of legs [B, K]."""


@dataclass
class Filtered:
    """The moments of the filter at B legs and its innovations at R rows, in the filter's coordinates.

    Means and covariances at the start of a leg (`start_mean` [B, n], `start_cov` [B, n, n]), at its end before
    (`end_mean`, `end_cov`) and after the measurements there (`post_mean`, `post_cov`), and its transition matrix `a`;
    the legs whose solution is not finite (`bad`), and the steps in each as shares of it (`shares` [B, K]). At rows: the
    errors of predictions `error` [R, C], each given the earlier channels, their variances `variance`, and the
    predictions without these, `mean`.
    """

    start_mean: Array
    start_cov: Array
    end_mean: Array
    end_cov: Array
    post_mean: Array
    post_cov: Array
    a: Array
    bad: Mask
    error: Array
    variance: Array
    mean: Array
    log: Mask
    shares: Array
    seen: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=np.bool_))
    value: float = float("inf")

    @classmethod
    def empty(cls, legs: int, n: int, rows: int, channels: int, log: Mask) -> Filtered:
        """Tables to fill."""
        a, b, c = (np.zeros((legs, n)) for _ in range(3))
        d, e, f, g = (np.zeros((legs, n, n)) for _ in range(4))
        p, q, r = (np.full((rows, channels), np.nan) for _ in range(3))
        return cls(a, d, b, e, c, f, g, np.zeros(legs, dtype=np.bool_), p, q, r, log, np.ones((legs, 1)))

    def moments(self, legs: Integers, end: bool = False) -> Moment:
        """Copies of the moments at the starts of legs, or at their ends; covariances that are not finite are zero."""
        mean, cov = (self.end_mean, self.end_cov) if end else (self.start_mean, self.start_cov)
        return Moment(mean[legs].copy(), np.where(np.isfinite(cov[legs]), cov[legs], 0.0))

    @property
    def guess(self) -> Guess:
        """The moments and steps as a guess for a vector nearby."""
        return self.start_mean, self.start_cov, self.end_mean, self.end_cov, self.shares

    def divide(self, legs: Integers, shares: Array) -> None:
        """Takes other steps in some legs."""
        self.shares = joined(self.shares, legs, shares)

    def lost(self, legs: Integers) -> None:
        """There is no solution in some legs."""
        self.bad[legs], self.value = True, float("inf")

    def put(self, legs: Integers, kept: Kept, a: Array, rows: Integers, innovations: Innovations) -> None:
        """Keeps what has been found at legs, and at the rows at their ends."""
        self.start_mean[legs], self.start_cov[legs] = kept.before.m, kept.before.p
        self.end_mean[legs], self.end_cov[legs], self.a[legs] = kept.end.m, kept.end.p, a
        self.post_mean[legs], self.post_cov[legs] = kept.post.m, kept.post.p
        self.error[rows], self.variance[rows] = innovations.error, innovations.variance
        self.mean[rows] = innovations.mean

    def finish(self, seen: Mask) -> None:
        """Computes the likelihood of the measurements that were used."""
        self.seen = seen
        error, variance = self.error[seen], self.variance[seen]
        sound = not self.bad.any() and np.isfinite(self.end_mean).all()
        if bool(sound and np.isfinite(error).all() and (variance > 0).all()):
            with np.errstate(over="ignore"):
                self.value = float(0.5 * np.sum(error**2 / variance + np.log(2 * np.pi * variance)))

    @property
    def finite(self) -> bool:
        """Whether the likelihood is."""
        return bool(np.isfinite(self.value))


@dataclass(frozen=True)
class Information:
    """The negative log likelihood, its gradient [size] and its expected information [size, size]: the covariance of the
    gradient over data of the model (Fisher), from first derivatives."""

    value: float
    gradient: Array
    matrix: Array

    @classmethod
    def none(cls, layout: Layout) -> Information:
        """That of a solution that is not finite."""
        return cls(float("inf"), np.zeros(layout.size), np.zeros((layout.size, layout.size)))


@dataclass
class Sums:
    """Sums over values of the derivatives of their log likelihoods.

    With an error e of variance v, each a function of the parameters, a value contributes e e_k / v + (1 - e^2 / v)
    v_k / (2 v) to the gradient, and e_k e_l / v + v_k v_l / (2 v^2) to the information.
    """

    layout: Layout
    _gradient: Array = field(init=False)
    _rows: list[Array] = field(default_factory=list, init=False)
    _owner: list[Integers] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        self._gradient = np.zeros((self.layout.parameters.trajectories, self.layout.width))

    def add(self, who: Integers, innovations: Innovations, seen: Mask) -> None:
        """Adds the values `seen` [b, C] of rows of the trajectories `who` [b]."""
        assert innovations.d_error is not None
        assert innovations.d_variance is not None
        row, channel = np.nonzero(seen)
        e, v = innovations.error[row, channel][:, None], innovations.variance[row, channel][:, None]
        de, dv = innovations.d_error[row, channel], innovations.d_variance[row, channel]
        np.add.at(self._gradient, who[row], e * de / v + 0.5 * (1 - e**2 / v) * dv / v)
        self._rows += [de / np.sqrt(v), dv / (v * np.sqrt(2.0))]
        self._owner += [who[row], who[row]]

    def information(self, value: float) -> Information:
        """The sums as a gradient and a matrix of the whole vector."""
        layout, width = self.layout, self.layout.width
        rows = np.concatenate([np.zeros((0, width)), *self._rows])
        owner = np.concatenate([np.zeros(0, dtype=np.int64), *self._owner])
        gradient, matrix = np.zeros(layout.size), np.zeros((layout.size, layout.size))
        shared = layout.places[0, : layout.shared] if len(layout.places) else np.zeros(0, dtype=np.int64)
        common = rows[:, : layout.shared]
        matrix[np.ix_(shared, shared)] = common.T @ common
        for trajectory, places in enumerate(layout.places):
            np.add.at(gradient, places, self._gradient[trajectory])
            own = places[layout.shared :]
            if len(own):
                mine = rows[owner == trajectory]
                block = mine[:, layout.shared :]
                matrix[np.ix_(own, own)] = block.T @ block
                cross = mine[:, : layout.shared].T @ block
                matrix[np.ix_(shared, own)] = cross
                matrix[np.ix_(own, shared)] = cross.T
        free = layout.free > 0
        return Information(value, np.where(free, gradient, 0.0), np.where(free[:, None] & free, matrix, 0.0))
