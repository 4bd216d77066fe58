"""A run's predictions of data that it was not fitted to, and their errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis import interval, noise_at
from gbspec.arrays import Array, Mask
from gbspec.files import finite
from gbspec.ir import counted_channels, logarithmic, residuals
from gbspec.studies.folds import Fold

if TYPE_CHECKING:
    from gbspec.ir import Model
    from gbspec.runs import Run
    from gbspec.training import FilteredRun, RowMoments

DRAWS = 24
"""Parameter vectors that show the uncertainty of a disturbed model's fit."""


@dataclass(frozen=True)
class Point:
    """A measurement that was held out, and its prediction: mean over members, standard deviation of a measurement.

    `predicted` and `sd` are NaN where the solution blew up. `in_logarithms`: the noise is lognormal, so that the
    interval is multiplicative; `counted`: it is that of a count. `ahead` and `ahead_sd`: the same from the measurements
    up to the row before, of models with random disturbances; NaN in first rows.
    """

    trajectory: str
    time: float
    channel: str
    measured: float
    predicted: float = math.nan
    sd: float = math.nan
    in_logarithms: bool = False
    counted: bool = False
    ahead: float = math.nan
    ahead_sd: float = math.nan

    @property
    def one_ahead(self) -> Point:
        """The point with the prediction from the row before in place of the other one."""
        return replace(self, predicted=self.ahead, sd=self.ahead_sd)


@dataclass(frozen=True)
class Errors:
    """Errors over held-out measurements of one channel; a number that cannot be computed is NaN.

    They are residuals (`gbspec.ir.residual`) with scale and weight 1. `nrmse` is relative to the channel's standard
    deviation in all data, `rmse_log` that of natural logarithms (if all values are positive), `covered` the share
    within the 90 % intervals. `unsolved` measurements have no prediction and do not count in the other numbers.
    """

    n: int
    rmse: float
    nrmse: float
    mae: float
    rmse_log: float
    covered: float
    unsolved: int

    def to_json(self) -> dict[str, object]:
        """Its numbers by name, null where there is none."""
        return {name: value if isinstance(value, int) else finite(value) for name, value in asdict(self).items()}


def held_out(run: Run, fold: Fold, window: int | None) -> list[Point]:
    """The predictions of a run for the held rows of its fold.

    For folds of trajectories, initial states and per-trajectory constants are estimated from the first rows (`window`)
    of each trajectory, which are then excluded from the errors. For folds over time, the trajectory is solved from the
    initial state that was learned from all its other rows, before and after the block; where states are disturbed,
    predictions are what these other rows say of the block (smoothed).
    """
    if run.model.diffusions:
        return _disturbed(run, fold, window)
    return _trajectories(run, fold, window) if fold.over == "trajectories" else _stretches(run, fold)


def _trajectories(run: Run, fold: Fold, window: int | None) -> list[Point]:
    from gbspec.analysis import forecast

    found = forecast(run, fold.whole, window=window)
    points = []
    for item in found.items:
        seen = np.array([use != "predicted" for use in item.used], dtype=bool)
        each = (item.label, item.times, found.channels, item.measured, item.mean, item.sd)
        points += _points(*each, ~seen, run.model)
    return points


def _stretches(run: Run, fold: Fold) -> list[Point]:
    from gbspec.analysis import learned_start, predict
    from gbspec.backends import Evaluator
    from gbspec.data import present_values

    evaluators = [Evaluator(member) for member in run.members]
    points = []
    present = present_values(run.model, fold.whole).items
    for position, (item, rows) in enumerate(zip(fold.whole.items, fold.held, strict=True)):
        each = [predict(one, run.model, item, learned_start(one, position, item)).channels for one in evaluators]
        mean = np.mean(each, axis=0)
        between = np.var(each, axis=0, ddof=1) if len(each) > 1 else np.zeros_like(mean)
        sd = np.sqrt(between + noise_at(run, mean) ** 2)
        found = (item.label, item.times, fold.whole.channels, present[position].values, mean, sd)
        points += _points(*found, rows, run.model)
    return points


def _disturbed(run: Run, fold: Fold, window: int | None) -> list[Point]:
    from gbspec.analysis import default_window
    from gbspec.training import filter_run

    if fold.over == "trajectories":
        windows = [default_window(item) if window is None else window for item in fold.whole.items]
        held = [_later(item.values, rows) for item, rows in zip(fold.whole.items, windows, strict=True)]
        used = filter_run(run, fold.whole, run.best, windows)
        paths = _of_new(run, fold, used, filter_run(run, fold.whole, run.best, own_of=used))
    else:
        held = list(fold.held)
        used = filter_run(run, fold.whole, run.best, hidden=held)
        paths = used.smoothed(DRAWS), filter_run(run, fold.whole, run.best, own_of=used).one_ahead(DRAWS)
    points = []
    for item, one, next_row, mask in zip(fold.whole.items, *paths, held, strict=True):
        rows = item.times >= item.start
        found = (item.label, item.times[rows], fold.whole.channels, item.values[rows], one.channels, one.measurement_sd)
        ahead = next_row.channels, next_row.measurement_sd
        points += _points(*found, mask[rows], run.model, ahead)
    return points


def _of_new(
    run: Run, fold: Fold, used: FilteredRun, all_seen: FilteredRun
) -> tuple[list[RowMoments], list[RowMoments]]:
    """What the filter says of trajectories that are not in the fit, from their first rows and one row ahead. The
    uncertainty of the constants is that of the fit: the few rows of a window would give a far larger one."""
    from gbspec.training import filter_run

    covariance = run.certainties(run.best).covariance
    known = filter_run(run, fold.kept, run.best) if covariance is None else covariance.without(run.values)
    return used.smoothed_after(known), all_seen.one_ahead_after(known)


def _later(values: Array, window: int) -> Mask:
    """The rows of a trajectory that follow the first `window` measured ones."""
    some = np.isfinite(values).any(axis=1).astype(np.int64)
    return np.asarray(np.cumsum(some) - some >= window, dtype=np.bool_)


def _points(
    label: str,
    times: Array,
    channels: Sequence[str],
    measured: Array,
    mean: Array,
    sd: Array,
    rows: Mask,
    model: Model,
    ahead: tuple[Array, Array] | None = None,
) -> list[Point]:
    """The held measurements of one trajectory; values [R, C] (`mean` and `sd` may have further columns).

    `ahead`: means and standard deviations from the row before.
    """
    tables = (measured, mean, sd) if ahead is None else (measured, mean, sd, *ahead)
    log, counts = logarithmic(model), counted_channels(model)

    def point(i: int, j: int, name: str) -> Point:
        value, predicted, deviation, *one_ahead = (float(table[i, j]) for table in tables)
        return Point(
            label, float(times[i]), name, value, predicted, deviation, bool(log[j]), bool(counts[j]), *one_ahead
        )

    return [
        point(int(i), j, name)
        for i in np.flatnonzero(rows)
        for j, name in enumerate(channels)
        if np.isfinite(measured[i, j])
    ]


def errors_one_ahead(points: Sequence[Point], sds: Mapping[str, float]) -> dict[str, Errors]:
    """The errors of predictions from the row before; empty for models without random disturbances."""
    return errors([point.one_ahead for point in points if math.isfinite(point.ahead)], sds)


def errors(points: Sequence[Point], sds: Mapping[str, float]) -> dict[str, Errors]:
    """The errors of each channel that has held-out measurements; `sds` are the channels' standard deviations."""
    found = {}
    for name, sd in sds.items():
        mine = [point for point in points if point.channel == name]
        solved = [point for point in mine if math.isfinite(point.predicted)]
        if mine:
            found[name] = _errors(solved, sd, len(mine) - len(solved))
    return found


def _errors(points: Sequence[Point], channel_sd: float, unsolved: int) -> Errors:
    if not points:
        return Errors(0, math.nan, math.nan, math.nan, math.nan, math.nan, unsolved)
    measured, predicted, sd = (np.array([getattr(p, part) for p in points]) for part in ("measured", "predicted", "sd"))
    both = np.array([False, True])  # once as they are, once as logarithms
    error, of_logs = residuals(predicted[:, None] * [1, 1], measured[:, None] * [1, 1], np.ones(2), both).T
    rmse = float(np.sqrt(np.mean(error**2)))
    logs = math.nan
    if (measured > 0).all() and (predicted > 0).all():
        logs = float(np.sqrt(np.mean(of_logs**2)))
    logarithms, counted = np.array([[p.in_logarithms, p.counted] for p in points], dtype=bool).T
    low, high = interval(predicted, sd, logarithms, counted=counted)
    inside = float(np.mean((measured >= low) & (measured <= high)))
    return Errors(len(points), rmse, rmse / channel_sd, float(np.mean(np.abs(error))), logs, inside, unsolved)
