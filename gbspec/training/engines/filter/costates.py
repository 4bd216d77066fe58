"""How the information of a model's other entries changes with the sizes of its disturbances and noises.

The errors of the filter are whitened data: with X [values, p] the derivatives of the data's means and V their
covariance, the derivatives E of the errors, of variances D, have E' D^-1 E = X' V^-1 X. Along a size s of V

    d(X' V^-1 X) / ds = -X' V^-1 (dV / ds) V^-1 X,

and V^-1 X is found by the disturbance smoother, backwards through the linear model that the filter has found. From
co-states r = 0 after the last value of a trajectory, at a value with the slopes c, the variance v and the gain g, and
at a leg with the transition A,

    u = E / v - g' r,    r <- r + c' u,    and    r <- A' r

(de Jong 1989; Koopman and Shephard 1992 for the score of sizes): a noise adds u' u dr/ds with its variance r, a
disturbance r' (dQ/ds) r with the co-states at the leg's end, and the covariance of the start r' (dP/ds) r. No
derivative of second order is needed.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.layout import Layout
from gbspec.training.engines.filter.legs import Legs
from gbspec.training.engines.filter.recursion import Flow, Innovations, Moment, Reading
from gbspec.training.engines.filter.result import Filtered
from gbspec.training.problem import Integers


@dataclass
class Costates:
    """The change of trace(F' X' V^-1 X F) along the `entries` [m] of the vector, for a `factor` F [size, p].

    `add` takes the chunks of legs in their order, `change` gives the result.
    """

    layout: Layout
    legs: Legs
    found: Filtered
    entries: Integers
    factor: Array
    _a: list[Array] = field(default_factory=list)
    _q: list[Array] = field(default_factory=list)
    _values: list[tuple[Array, ...]] = field(default_factory=list)

    @property
    def _columns(self) -> Integers:
        """The columns of the sensitivities that belong to the entries."""
        shared = self.layout.places[0, : self.layout.shared]
        return np.array([np.flatnonzero(shared == entry)[0] for entry in self.entries], dtype=np.int64)

    def add(self, owner: Integers, flow: Flow, reading: Reading, innovations: Innovations) -> None:
        """Takes some legs, the rows at their ends, which belong to the trajectories `owner`, and their errors."""
        (b, n), columns = flow.at.shape, self._columns
        self._a.append(flow.a)
        if flow.by_rest is not None:
            self._q.append(flow.by_rest[:, n:, columns].reshape(b, n, n, -1))
        else:
            assert flow.d_q is not None
            self._q.append(flow.d_q[..., columns])
        channels = reading.y.shape[1]
        if reading.by_rest is not None:
            noise = reading.by_rest[:, channels * (n + 1) :, columns]
        else:
            assert reading.d_r is not None
            noise = reading.d_r[..., columns]
        assert innovations.d_error is not None
        seen = reading.seen[:, :, None]
        errors = np.matmul(innovations.d_error, self.factor[self.layout.places[owner]])
        slopes = np.where(seen, reading.c, 0.0)
        self._values.append((np.where(seen, errors, 0.0), innovations.variance, slopes, np.where(seen, noise, 0.0)))

    def change(self, start: Moment) -> Array:
        """The change [m]; `start` are the moments at the starts of the trajectories."""
        a, q = np.concatenate(self._a), np.concatenate(self._q)
        errors, variance, c, noise = (np.concatenate(parts) for parts in zip(*self._values, strict=True))
        place = self.legs.rows_of(np.arange(len(self.legs.owner)))[1]
        gains = _gains(self.found.end_cov[place >= 0], variance, c)
        out = np.zeros(len(self.entries))
        r = np.zeros((*start.m.shape, self.factor.shape[1]))
        for number in range(self.legs.places - 1, -1, -1):
            span = self.legs.at(number)
            owner, at = self.legs.owner[span], place[span]
            who, mine = owner[at >= 0], at[at >= 0]
            for channel in range(c.shape[1] - 1, -1, -1):
                weighted = errors[mine, channel] / variance[mine, channel, None]
                u = weighted - np.matmul(gains[mine, channel, None], r[who])[:, 0]
                out -= np.einsum("bm,bp,bp->m", noise[mine, channel], u, u)
                r[who] += c[mine, channel, :, None] * u[:, None]
            here = r[owner]
            out -= _sandwiched(q[span], here)
            r[owner] = np.matmul(a[span].transpose(0, 2, 1), here)
        assert start.dp is not None
        return out - _sandwiched(start.dp[..., self._columns], r)


def _sandwiched(q: Array, r: Array) -> Array:
    """The sum over b of trace(r' q r) of matrices [b, n, n, m] and co-states [b, n, p]."""
    return np.tensordot(np.matmul(r, r.transpose(0, 2, 1)), q, 3)


def _gains(p: Array, variance: Array, c: Array) -> Array:
    """The gains [R, C, n] of the values of rows, before which covariances are `p` [R, n, n]; zero where the slopes `c`
    are."""
    gains = np.zeros_like(c)
    for channel in range(c.shape[1]):
        slope = c[:, channel]
        pc = np.matmul(p, slope[:, :, None])[:, :, 0]
        gains[:, channel] = pc / variance[:, channel, None]
        p = p - gains[:, channel, :, None] * pc[:, None]
    return gains


__all__ = ["Costates"]
