"""The Kalman filter over the legs of all trajectories side by side, with the sensitivities of its moments.

All channels of a row are linearised at the predicted mean and then taken one after the other, which is the same as
together since their noises are independent; each value then has a mean and a variance given all earlier ones, and the
log likelihood is a sum over values (Schweppe 1965; Kristensen, Madsen, Jorgensen 2004). Sensitivities are propagated
with the moments (Gupta and Mehra 1974), all parameters at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.problem import Integers

Tables = TypeVar("Tables", "Flow", "Reading")


@dataclass
class Moment:
    """Mean `m` [N, n] and covariance `p` [N, n, n], and where wanted their derivatives [N, n, k] and [N, n, n, k]."""

    m: Array
    p: Array
    dm: Array | None = None
    dp: Array | None = None

    def of(self, who: Integers) -> Moment:
        """The moments of some trajectories."""
        return Moment(*(None if table is None else table[who] for table in vars(self).values()))  # type: ignore[arg-type]

    def put(self, who: Integers | slice, other: Moment) -> None:
        """Replaces the moments of some trajectories, in place."""
        for mine, its in zip(vars(self).values(), vars(other).values(), strict=True):
            if mine is not None:
                mine[who] = its


@dataclass(frozen=True)
class Flow:
    """What happens in a leg of b trajectories, linearised at the coordinates `at` [b, n].

    `mean` [b, n] at its end, the transition `a` and the added covariance `q` [b, n, n], of a model that is not linear
    at the covariance `cov` [b, n, n]. Derivatives: of a linear one those in the parameters `d_mean`, `d_a`, `d_q`
    [b, ..., k]; else those of mean and covariance at the end (n, then n * n numbers) in those at the start, `by_moment`
    [b, n + n n, n + n n], and in the parameters, `by_rest` [b, n + n n, k].
    """

    at: Array
    mean: Array
    a: Array
    q: Array
    cov: Array | None = None
    by_moment: Array | None = None
    by_rest: Array | None = None
    d_mean: Array | None = None
    d_a: Array | None = None
    d_q: Array | None = None


def predicted(before: Moment, flow: Flow) -> Moment:
    """The moments at the end of a leg."""
    m = flow.mean + np.matmul(flow.a, (before.m - flow.at)[:, :, None])[:, :, 0]
    pa = np.matmul(before.p, flow.a.transpose(0, 2, 1))
    p = np.matmul(flow.a, pa) + flow.q
    if before.dm is None or before.dp is None:
        return Moment(m, _symmetric(p))
    b, n, k = before.dm.shape
    if flow.by_moment is not None and flow.by_rest is not None:
        moved = np.matmul(flow.by_moment, _stacked(before)) + flow.by_rest
        return Moment(m, _symmetric(p), moved[:, :n], moved[:, n:].reshape(b, n, n, k))
    assert flow.d_mean is not None
    assert flow.d_a is not None
    assert flow.d_q is not None
    dm = flow.d_mean + np.matmul(flow.a, before.dm)
    moved = np.matmul(pa.transpose(0, 2, 1)[:, None], flow.d_a)
    inner = np.matmul(flow.a, before.dp.reshape(b, n, n * k)).reshape(b, n, n, k)
    dp = flow.d_q + moved + moved.transpose(0, 2, 1, 3) + np.matmul(flow.a[:, None], inner)
    return Moment(m, _symmetric(p), dm, dp)


def _stacked(moment: Moment) -> Array:
    """The derivatives of mean and covariance [b, n + n n, k]."""
    assert moment.dm is not None
    assert moment.dp is not None
    b, n, k = moment.dm.shape
    return np.concatenate([moment.dm, moment.dp.reshape(b, n * n, k)], axis=1)


@dataclass(frozen=True)
class Reading:
    """The channels of a row of b trajectories, linearised at the coordinates `at` [b, n].

    Predictions `y` [b, C] and slopes `c` [b, C, n], measurements `value` [b, C] with variances `r` [b, C], and which
    are `seen` [b, C]; of readings that are not linear at the covariance `cov` [b, n, n]. Derivatives: of linear ones
    those in the parameters `d_y`, `d_c` and `d_r` [b, ..., k]; else those of predictions, slopes and variances (C, then
    C * n, then C numbers) in the moments, `by_moment` [b, C (n + 2), n + n n], and in the parameters, `by_rest`
    [b, C (n + 2), k].
    """

    at: Array
    y: Array
    c: Array
    value: Array
    r: Array
    seen: Mask
    cov: Array | None = None
    by_moment: Array | None = None
    by_rest: Array | None = None
    d_y: Array | None = None
    d_c: Array | None = None
    d_r: Array | None = None

    def slopes(self, before: Moment) -> tuple[Array, Array, Array]:
        """The derivatives [b, ..., k] of predictions, slopes and variances at moments with derivatives."""
        if self.by_moment is None or self.by_rest is None:
            assert self.d_y is not None
            assert self.d_c is not None
            assert self.d_r is not None
            assert before.dm is not None
            return self.d_y + np.matmul(self.c, before.dm), self.d_c, self.d_r
        table, (b, channels, n) = np.matmul(self.by_moment, _stacked(before)) + self.by_rest, self.c.shape
        y, c, r = np.split(table, [channels, channels * (n + 1)], axis=1)
        return y, c.reshape(b, channels, n, -1), r


@dataclass
class Innovations:
    """Errors and variances [b, C] of the values of a row, each given the earlier ones, the predictions `mean` without
    these, and where wanted the derivatives [b, C, k] of errors and variances. What was not seen has the error 0 and the
    variance 1."""

    error: Array
    variance: Array
    mean: Array
    d_error: Array | None = None
    d_variance: Array | None = None

    @classmethod
    def empty(cls, rows: int, channels: int, width: int | None) -> Innovations:
        """Tables to fill."""
        slopes = (None, None) if width is None else tuple(np.zeros((rows, channels, width)) for _ in range(2))
        return cls(np.zeros((rows, channels)), np.ones((rows, channels)), np.zeros((rows, channels)), *slopes)


@dataclass
class Kept:
    """Means and covariances at the start of each leg, at its end, and after the measurements there."""

    before: Moment
    end: Moment
    post: Moment

    @classmethod
    def empty(cls, legs: int, n: int) -> Kept:
        """Tables to fill."""
        return cls(*(Moment(np.zeros((legs, n)), np.zeros((legs, n, n))) for _ in range(3)))


def advanced(
    moment: Moment, owner: Integers, flow: Flow, reading: Reading, place: Integers, kept: Kept | None
) -> Innovations:
    """The filter over B legs in their order; what is seen at the rows [R] of `reading`.

    `moment` has the moments of all trajectories, which are replaced by those after the legs; `owner` [B] is the
    trajectory of each leg, and `place` [B] the row at its end (-1: none). `kept` gets the moments on the way. The
    compiled `recursion.c` does the same.
    """
    rows, channels = reading.y.shape
    out = Innovations.empty(rows, channels, None if moment.dm is None else moment.dm.shape[2])
    for begin, end in pairwise(_ends(owner)):
        legs, who = slice(int(begin), int(end)), owner[begin:end]
        before = moment.of(who)
        now = predicted(before, part_of(flow, legs))
        if kept is not None:
            kept.before.put(legs, before)
            kept.end.put(legs, now)
        mine = np.flatnonzero(place[legs] >= 0)
        if len(mine):
            at = place[legs][mine]
            after, found = updated(now.of(mine), part_of(reading, at))
            now.put(mine, after)
            for table, values in zip(vars(out).values(), vars(found).values(), strict=True):
                if table is not None:
                    table[at] = values
        if kept is not None:
            kept.post.put(legs, now)
        moment.put(who, now)
    return out


def _ends(owner: Integers) -> list[int]:
    """Where the legs of each place end, after a zero: those before are of different trajectories."""
    order = np.argsort(owner, kind="stable")
    number = np.zeros(len(owner), dtype=np.int64)
    number[order] = np.arange(len(owner)) - np.searchsorted(owner[order], owner[order])
    return [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(owner)]


def part_of(tables: Tables, which: slice | Integers) -> Tables:
    """Some rows of all tables."""
    parts = (None if table is None else table[which] for table in vars(tables).values())
    return type(tables)(*parts)  # type: ignore[arg-type]


def put(tables: Tables, where: Integers, new: Tables) -> Tables:
    """The tables with some rows replaced, in place."""
    for name, part in vars(new).items():
        if part is not None:
            getattr(tables, name)[where] = part
    return tables


def standing(before: Moment, width: int | None, linear: bool) -> Flow:
    """The flows in which nothing happens; with derivatives in `width` parameters unless that is None."""
    b, n = before.m.shape
    both, unit = n + n * n, np.tile(np.eye(n), (b, 1, 1))
    plain = Flow(before.m, before.m.copy(), unit, np.zeros((b, n, n)), None if linear else before.p)
    if width is None:
        return plain
    if linear:
        d_mean, d_a, d_q = (np.zeros((b, *shape, width)) for shape in ((n,), (n, n), (n, n)))
        return replace(plain, d_mean=d_mean, d_a=d_a, d_q=d_q)
    return replace(plain, by_moment=np.tile(np.eye(both), (b, 1, 1)), by_rest=np.zeros((b, both, width)))


def updated(before: Moment, reading: Reading) -> tuple[Moment, Innovations]:
    """The moments after the measurements of a row, and what these showed."""
    b, channels = reading.y.shape
    y = reading.y + np.matmul(reading.c, (before.m - reading.at)[:, :, None])[:, :, 0]
    now = Moment(before.m.copy(), before.p.copy())
    out = Innovations.empty(b, channels, None if before.dm is None else before.dm.shape[2])
    out.mean[:] = y
    slopes = None
    if before.dm is not None and before.dp is not None:
        slopes = reading.slopes(before)
        now.dm, now.dp = before.dm.copy(), before.dp.copy()
    for channel in range(channels):
        who = np.flatnonzero(reading.seen[:, channel])
        if len(who):
            rows = slice(None) if len(who) == b else who
            _one_value(before, now, reading, channel, rows, y[rows, channel], slopes, out)
    return now, out


def _one_value(
    before: Moment,
    now: Moment,
    reading: Reading,
    channel: int,
    rows: slice | np.ndarray,
    y: Array,
    slopes: tuple[Array, Array, Array] | None,
    out: Innovations,
) -> None:
    """Takes one channel's values into account, in place."""
    c, r = reading.c[rows, channel], reading.r[rows, channel]
    m, p = now.m[rows], now.p[rows]
    moved = m - before.m[rows]
    error = reading.value[rows, channel] - y - np.einsum("bi,bi->b", c, moved)
    pc = np.matmul(p, c[:, :, None])[:, :, 0]
    variance = np.einsum("bi,bi->b", c, pc) + r
    gain = pc / variance[:, None]
    out.error[rows, channel], out.variance[rows, channel] = error, variance
    if slopes is not None and now.dm is not None and now.dp is not None:
        dy, dc, dr = slopes
        assert before.dm is not None
        assert out.d_error is not None
        assert out.d_variance is not None
        dm, dp, dcc = now.dm[rows], now.dp[rows], dc[rows, channel]
        n, k = dm.shape[1:]
        d_error = -dy[rows, channel] - np.matmul(c[:, None], dm - before.dm[rows])[:, 0]
        d_error -= np.matmul(moved[:, None], dcc)[:, 0]
        dpc = np.matmul(c[:, None], dp.reshape(-1, n, n * k)).reshape(-1, n, k) + np.matmul(p, dcc)
        d_variance = np.matmul(c[:, None], dpc)[:, 0] + np.matmul(pc[:, None], dcc)[:, 0] + dr[rows, channel]
        d_gain = (dpc - gain[:, :, None] * d_variance[:, None]) / variance[:, None, None]
        now.dm[rows] = dm + d_gain * error[:, None, None] + gain[:, :, None] * d_error[:, None]
        part = d_gain[:, :, None] * pc[:, None, :, None] + gain[:, :, None, None] * dpc[:, None]
        now.dp[rows] = dp - part
        out.d_error[rows, channel], out.d_variance[rows, channel] = d_error, d_variance
    now.m[rows] = m + gain * error[:, None]
    # (1 - K c) P (1 - K c)' + K r K', which stays positive whatever is rounded
    left = np.eye(p.shape[1]) - gain[:, :, None] * c[:, None]
    p = np.matmul(np.matmul(left, p), left.transpose(0, 2, 1)) + r[:, None, None] * gain[:, :, None] * gain[:, None]
    now.p[rows] = _symmetric(p)


def _symmetric(p: Array) -> Array:
    return 0.5 * (p + p.transpose(0, 2, 1))
