"""A curve through each measured state of each trajectory, for warm starts and imputed values.

Either interpolating (cubic; shape preserving where the data are monotone, so that a curve does not wiggle between
sparse points) or smoothed by generalised cross-validation, or smooth in pieces where events set states. The warm start
tries them: cross-validation alone would treat sparsely sampled oscillations as noise.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, make_smoothing_spline

from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.ir import Model
from gbspec.training.starts.jumps import gaps, jumping
from gbspec.training.starts.readings import readings

Curve = Callable[[Array], Array]
CurveKind = Literal["interpolating", "smooth", "pieces"]
TOGETHER = 1e-6
"""Rows that are closer than this part of the usual distance have the same time."""


@dataclass(frozen=True)
class StateCurve:
    """One state of one trajectory over its measured span [low, high]; linear beyond, within the range of the values."""

    value: Curve
    slope: Curve
    low: float
    high: float
    bottom: float
    top: float

    def extended(self, times: Array) -> Array:
        """Values at any times; beyond the measured span along the tangent at its end, limited to the range of the
        data."""
        inside = np.clip(times, self.low, self.high)
        tangent = self.value(inside) + self.slope(inside) * (times - inside)
        margin = 0.25 * (self.top - self.bottom)
        bounded = np.clip(tangent, self.bottom - margin, self.top + margin)
        return np.asarray(np.where(times == inside, self.value(inside), bounded), dtype=np.float64)


@dataclass(frozen=True)
class Curves:
    """Curves by trajectory and state (None: not measured there, or fewer than two points).

    `gaps`: for each trajectory the times [G, 2] between which no slope is that of a balance, since states may jump.
    """

    items: tuple[tuple[StateCurve | None, ...], ...]
    gaps: tuple[Array, ...]

    def covers(self, state: int) -> bool:
        """Whether the state has a curve in at least one trajectory."""
        return any(item[state] is not None for item in self.items)


def fit_curves(model: Model, trajectories: Trajectories, kind: CurveKind = "interpolating") -> Curves:
    """Fits all curves: interpolating, or smooth (where a series is long enough for that), or smooth in pieces.

    Of states that are measured directly, and of those whose values formulas of channels give.
    """
    values = _measured(model, trajectories)
    between = gaps(model, trajectories, values) if kind == "pieces" else [np.zeros((0, 2))] * len(values)
    items, without = [], []
    for item, states, gap in zip(trajectories.items, values, between, strict=True):
        row: list[StateCurve | None] = []
        blank = [gap]
        for state in range(len(model.states)):
            seen = np.isfinite(states[:, state])
            t, y = item.times[seen], states[seen, state]
            if kind == "pieces":
                curve, more = _in_pieces(t, y, gap)
                row.append(curve)
                blank.append(more)
            else:
                row.append(curve_of(t, y, smoothed(t, y) if kind == "smooth" else None))
        items.append(tuple(row))
        without.append(np.concatenate(blank))
    return Curves(tuple(items), tuple(without))


def curve_kinds(model: Model, curves: Curves) -> tuple[CurveKind, ...]:
    """The kinds that a warm start tries after interpolating `curves`."""
    return ("smooth", "pieces") if any(curves.covers(i) for i in jumping(model)) else ("smooth",)


def _measured(model: Model, trajectories: Trajectories) -> list[Array]:
    """The measured values of states [R, n_states] of each trajectory, NaN where there are none."""
    direct = {channel.state: i for i, channel in enumerate(model.channels) if channel.state is not None}
    through, out = readings(model), []
    for item in trajectories.items:
        values = np.full((len(item.times), len(model.states)), np.nan)
        for state in range(len(model.states)):
            if state in direct:
                values[:, state] = item.values[:, direct[state]]
            elif state in through:
                found = through[state]
                values[:, state] = found.values(item.values[:, found.channel], item.condition)
        out.append(values)
    return out


LONG = 40
"""Rows of a piece from which it is a smoothing spline; shorter ones are lines up to noise, and have a parabola."""


@dataclass(frozen=True)
class Pieces:
    """One curve after another, the `n`-th one up to the time `ends[n]`; beyond its rows, `spans` [n, 2], as there."""

    curves: tuple[Curve, ...]
    ends: Array
    spans: Array

    def __call__(self, t: Array) -> Array:
        """The values at times `t`."""
        which, out = np.searchsorted(self.ends, t), np.zeros(np.shape(t))
        for i in np.unique(which):
            here = which == i
            out[here] = self.curves[i](np.clip(t[here], *self.spans[i]))
        return out


def _in_pieces(t: Array, y: Array, gaps: Array) -> tuple[StateCurve | None, Array]:
    """The curve in pieces with `gaps` [G, 2] between them (None: fewer than two points), and further times [H, 2] at
    which it has no slope: around single rows, and where it was not measured from one gap to another."""
    if len(t) < 2:
        return None, np.zeros((0, 2))
    ends = gaps.mean(axis=1)
    which = np.searchsorted(ends, t)
    found = np.unique(which).tolist()
    pieces = [_piece(t[which == i], y[which == i]) for i in found]
    until = np.array([ends[i] for i in found[:-1]])
    spans = np.array([t[which == i][[0, -1]] for i in found])
    value, slope = (Pieces(tuple(piece[k] for piece in pieces), until, spans) for k in (0, 1))
    edges = np.concatenate([[-np.inf], ends, [np.inf]])
    few = np.bincount(which, minlength=len(ends) + 1) < 2
    low, high, bottom, top = float(t[0]), float(t[-1]), float(y.min()), float(y.max())
    return StateCurve(value, slope, low, high, bottom, top), np.stack([edges[:-1], edges[1:]], axis=1)[few]


def _piece(t: Array, y: Array) -> tuple[Curve, Curve]:
    """A smooth curve of a few points, and its slope: a spline, or a parabola, a line or a constant."""
    smooth = smoothed(t, y) if len(t) >= LONG else None
    if smooth is not None:
        return smooth, smooth.derivative()
    polynomial = np.polynomial.Polynomial.fit(t, y, min(len(t) // 2, 2)) if len(t) > 1 else np.polynomial.Polynomial(y)
    return polynomial, polynomial.deriv()


def smoothed(t: Array, y: Array, unit: float | None = None) -> SmoothCurve | None:
    """A smoothing spline, its penalty by generalised cross-validation; None with fewer than 8 points, or where
    their spacings differ so much that there is none.

    Penalties are searched between 0 and the number of points, with times in multiples of `unit` (None: the span).
    """
    t, y = _merged(t, y)
    if len(t) < 8:
        return None
    width, deviation = t[-1] - t[0] if unit is None else unit, y.std()
    if deviation == 0:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            spline = make_smoothing_spline((t - t[0]) / width, (y - y.mean()) / deviation)
        except (ValueError, np.linalg.LinAlgError):  # the equations are singular: spacings differ by many decades
            return None
    return SmoothCurve(spline, float(t[0]), float(width), float(y.mean()), float(deviation))


@dataclass(frozen=True)
class SmoothCurve:
    """A spline of scaled time and value, in natural units."""

    spline: Curve
    origin: float
    width: float
    mean: float
    deviation: float

    def __call__(self, t: Array) -> Array:
        """The values at times `t`."""
        return np.asarray(self.mean + self.deviation * self.spline((t - self.origin) / self.width), dtype=np.float64)

    def derivative(self) -> SmoothCurve:
        """The slope in natural units."""
        return SmoothCurve(self.spline.derivative(), self.origin, self.width, 0.0, self.deviation / self.width)  # type: ignore[attr-defined]


def _merged(t: Array, y: Array) -> tuple[Array, Array]:
    """The series with the mean of values at times that are the same up to rounding: 0.6 and 0.6000000000000001."""
    gaps = np.diff(t)
    if not len(gaps) or (gaps > TOGETHER * np.median(gaps)).all():
        return t, y
    group = np.concatenate([[0], np.cumsum(gaps > TOGETHER * np.median(gaps))])
    count = np.bincount(group)
    return np.bincount(group, t) / count, np.bincount(group, y) / count


def curve_of(t: Array, y: Array, smooth: SmoothCurve | None = None) -> StateCurve | None:
    """The curve through values `y` at times `t`, or the smooth curve fitted to them; None with fewer than two."""
    t, y = _merged(t, y)
    if len(t) < 2:
        return None
    low, high, bottom, top = float(t[0]), float(t[-1]), float(y.min()), float(y.max())
    if smooth is not None:
        return StateCurve(smooth, smooth.derivative(), low, high, bottom, top)
    change = np.diff(y)
    if len(t) < 4 or (change >= 0).all() or (change <= 0).all():
        shape = PchipInterpolator(t, y)
    else:
        shape = CubicSpline(t, y)
    return StateCurve(shape, shape.derivative(), low, high, bottom, top)
