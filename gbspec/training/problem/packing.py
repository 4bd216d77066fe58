"""Trajectories as arrays for the solver: key rows, contiguous sub-steps, resets and doses.

A *key row* is a measurement time of a trajectory. Between key rows the solver takes *sub-steps* that are not longer
than the largest step allowed; a discontinuity of an input or the arrival of a dose is always a boundary of sub-steps
(for learned lags see `path`). Each trajectory's sub-steps are stored without gaps, so that in step `s` of the batch
every trajectory takes its own `s`-th sub-step; completed trajectories take steps of length zero, only at the end.
(Synchronising the batch at every key row would require about three times as many steps on irregular data.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.data import Limits, Trajectories, Trajectory, evaluate
from gbspec.data import weights as weights_of
from gbspec.ir import RK4, Method, Model, insets
from gbspec.training.problem.arrivals import (
    DoseTable,
    Integers,
    Lags,
    boundaries,
    dose_table,
    known_lags,
    switches_of,
    tolerance_of,
)
from gbspec.training.problem.delays import largest_steps

SAME_TIME = 1e-4
"""Measurements whose distance is below this part of the mean interval, and of the time that has passed (as that of
logarithmically spaced ones is not), were made at the same time."""


@dataclass(frozen=True)
class Packed:
    """A batch of N trajectories of at most T sub-steps, with R key rows in all.

    `t`, `h` [T, N]: start and length of each sub-step; `inputs` [T, N, nodes, n_inputs]: inputs at `nodes`, the
    method's nodes as fractions of a step (the right limit at its start, the left limit at its end); `condition`
    [N, n_conditions]; `start` [N].
    Rows are ordered by their place within their trajectory, then by trajectory: `row_trajectory`, `row_index` (0 is a
    trajectory's first row), `row_step` (sub-steps taken on arrival) [R], `row_time` [R], `values` [R, C] (NaN: not
    measured), `weights` [R, C] (square root of the count; 0: not measured), `sd` [R, C] (NaN: none given),
    `scatter` [R, C] (sum of squared deviations of replicates from their average), `row_inputs` [R, n_inputs], `limits`
    of censored entries, which have no value and the weight 1. A dose is added to the state after a measurement at the
    same time.
    """

    t: Array
    h: Array
    nodes: tuple[float, ...]
    inputs: Array
    condition: Array
    start: Array
    steps: Integers
    row_trajectory: Integers
    row_index: Integers
    row_step: Integers
    row_time: Array
    values: Array
    weights: Array
    sd: Array
    scatter: Array
    row_inputs: Array
    limits: Limits
    doses: DoseTable
    labels: tuple[str, ...]
    max_step: float

    @property
    def trajectories(self) -> int:
        """Number of trajectories."""
        return int(self.condition.shape[0])

    def without(self, channels: Mask) -> Packed:
        """The same without the measurements of some channels [N, C] of the trajectories."""
        if not channels.any():
            return self
        return replace(self, weights=np.where(channels[self.row_trajectory], 0.0, self.weights))

    @property
    def depth(self) -> int:
        """Number of sub-steps of the longest trajectory."""
        return int(self.t.shape[0])

    @property
    def rows(self) -> int:
        """Number of key rows."""
        return int(self.row_time.shape[0])

    @property
    def substeps(self) -> int:
        """Number of sub-steps of positive length."""
        return int(self.steps.sum())

    @cached_property
    def row_table(self) -> Integers:
        """The key row [N, places] of each trajectory at each place (0 beyond its last)."""
        table = np.zeros((self.trajectories, int(self.row_index.max(initial=0)) + 1), dtype=np.int64)
        table[self.row_trajectory, self.row_index] = np.arange(self.rows)
        return table

    @cached_property
    def previous_row(self) -> Integers:
        """The key row before each one in its trajectory [R] (itself, if it is the first)."""
        return np.asarray(self.row_table[self.row_trajectory, np.maximum(self.row_index - 1, 0)], dtype=np.int64)

    @property
    def first_step(self) -> Integers:
        """The sub-step at which the interval that ends at each key row begins [R]."""
        begins = np.where(self.row_index == 0, 0, self.row_step[self.previous_row])
        return np.asarray(begins, dtype=np.int64)

    @property
    def inputs_before(self) -> Array:
        """The inputs that hold before the start of each trajectory [N, n_inputs]: those at its start."""
        first, moving = self.row_index == 0, self.steps > 0
        found = np.zeros((self.trajectories, self.row_inputs.shape[1]))
        found[self.row_trajectory[first]] = self.row_inputs[first]  # which is at the start, if there are no steps
        if self.depth:
            found[moving] = self.inputs[0, moving, 0]
        return found

    def take(self, indices: Sequence[int] | Integers) -> Packed:
        """The packing of some of the trajectories, in the order given (repeats allowed)."""
        index = np.asarray(indices, dtype=np.int64)
        order = np.concatenate(
            [np.zeros(0, dtype=np.int64), *(np.flatnonzero(self.row_trajectory == i) for i in index)]
        )
        owner = np.repeat(np.arange(len(index)), [int(np.sum(self.row_trajectory == i)) for i in index])
        by_place = np.lexsort((owner, self.row_index[order]))
        rows, owner = order[by_place], owner[by_place]
        depth = int(self.steps[index].max(initial=0))
        return replace(
            self,
            t=self.t[:depth, index],
            h=self.h[:depth, index],
            inputs=self.inputs[:depth, index],
            condition=self.condition[index],
            start=self.start[index],
            steps=self.steps[index],
            row_trajectory=owner.astype(np.int64),
            row_index=self.row_index[rows],
            row_step=self.row_step[rows],
            row_time=self.row_time[rows],
            values=self.values[rows],
            weights=self.weights[rows],
            sd=self.sd[rows],
            scatter=self.scatter[rows],
            row_inputs=self.row_inputs[rows],
            limits=self.limits.rows(rows),
            doses=self.doses.take(index),
            labels=tuple(self.labels[i] for i in index),
        )


def default_max_step(trajectories: Trajectories) -> float:
    """A fifth of the typical interval between two measurements of the same channel, rounded to 1, 2 or 5 x 10^n.

    Intervals are evaluated for each channel separately, because channels with different measurement times make the rows
    of a table dense although the dynamics are not faster; those between measurements at nearly the same time, as of
    replicates that were taken one after the other, tell nothing of the dynamics. Whether the step is small enough is
    checked after every fit by solving with half the step.
    """
    gaps = [
        _apart(item.times[np.isfinite(item.values[:, channel])], item.start)
        for item in trajectories.items
        for channel in range(item.values.shape[1])
    ]
    intervals = np.concatenate([*gaps, np.zeros(0)])
    if len(intervals):
        typical = float(np.median(intervals)) / 5
    else:
        spans = [item.end - item.start for item in trajectories.items]
        typical = max(max(spans, default=1.0), 1e-12) / 50
    scale = 10.0 ** np.floor(np.log10(typical))
    return float(scale * min((1.0, 2.0, 5.0, 10.0), key=lambda m: abs(np.log(m * scale / typical))))


def _apart(times: Array, start: float) -> Array:
    """The intervals between measurements that were not made at the same time."""
    gaps = np.diff(times)
    if not len(gaps):
        return gaps
    return np.asarray(gaps[gaps > SAME_TIME * np.minimum(gaps.mean(), times[1:] - start)], dtype=np.float64)


def pack(
    trajectories: Trajectories,
    model: Model,
    max_step: float,
    rng: np.random.Generator | None = None,
    method: Method = RK4,
) -> Packed:
    """Packs a data set for a Runge-Kutta method with sub-steps of at most `max_step` (in the unit of time).

    With `rng`, the sub-steps of an interval have random lengths (at most `max_step`), so that a learned right-hand side
    cannot become dependent on one particular step.
    """
    nodes = tuple(map(float, method.nodes))
    plans = _plans(trajectories, model, max_step, nodes, rng)
    depth = max((len(plan.h) for plan in plans), default=0)
    count, n_inputs = len(plans), len(model.inputs)
    t, h = np.zeros((depth, count)), np.zeros((depth, count))
    inputs = np.zeros((depth, count, len(nodes), n_inputs))
    for i, plan in enumerate(plans):
        n = len(plan.h)
        t[:n, i], h[:n, i] = plan.t, plan.h
        t[n:, i] = plan.t[-1] + plan.h[-1] if n else trajectories.items[i].start
        inputs[:n, i] = plan.inputs
        if 0 < n < depth:
            inputs[n:, i] = plan.inputs[-1, -1]
    none = np.zeros(0, dtype=np.int64)
    owner = np.concatenate([none, *(np.full(len(plan.row_step), i) for i, plan in enumerate(plans))])
    place = np.concatenate([none, *(np.arange(len(plan.row_step)) for plan in plans)])
    order = np.lexsort((owner, place))

    def rows(arrays: Sequence[NDArray[np.generic]], width: int | None = None) -> Array:
        empty = np.zeros(0) if width is None else np.zeros((0, width))
        return np.asarray(np.concatenate([*arrays, empty]), dtype=np.float64)[order]

    channels = len(trajectories.channels)
    return Packed(
        t=t,
        h=h,
        nodes=nodes,
        inputs=inputs,
        condition=np.array([item.condition for item in trajectories.items], dtype=np.float64).reshape(count, -1),
        start=np.array([item.start for item in trajectories.items], dtype=np.float64),
        steps=np.array([len(plan.h) for plan in plans], dtype=np.int64),
        row_trajectory=owner[order].astype(np.int64),
        row_index=place[order].astype(np.int64),
        row_step=rows([plan.row_step.astype(np.float64) for plan in plans]).astype(np.int64),
        row_time=rows([plan.row_time for plan in plans]),
        values=rows([plan.values for plan in plans], channels),
        weights=rows([plan.weights for plan in plans], channels),
        sd=rows([plan.sd for plan in plans], channels),
        scatter=rows([plan.scatter for plan in plans], channels),
        row_inputs=rows([plan.row_inputs for plan in plans], n_inputs),
        limits=Limits(
            rows([plan.limits.value for plan in plans], channels),
            rows([plan.limits.side for plan in plans], channels).astype(np.int8),
        ),
        doses=dose_table(trajectories, model),
        labels=tuple(item.label for item in trajectories.items),
        max_step=max_step,
    )


@dataclass(frozen=True)
class _Plan:
    """One trajectory's sub-steps and key rows (fields as in `Packed`, without the batch's axis)."""

    t: Array
    h: Array
    inputs: Array
    row_step: Integers
    row_time: Array
    values: Array
    weights: Array
    sd: Array
    scatter: Array
    row_inputs: Array
    limits: Limits


def _plans(
    trajectories: Trajectories, model: Model, max_step: float, nodes: Sequence[float], rng: np.random.Generator | None
) -> list[_Plan]:
    """The sub-steps of each trajectory, none longer than its shortest delay."""
    lags, limits = known_lags(trajectories, model), largest_steps(trajectories, model, max_step)
    each = zip(trajectories.items, lags, limits, strict=True)
    switches = switches_of(model)
    return [_plan(item, model, limit, nodes, rng, own, switches(item, 0.0)) for item, own, limit in each]


def _plan(
    item: Trajectory,
    model: Model,
    max_step: float,
    nodes: Sequence[float],
    rng: np.random.Generator | None,
    lags: Lags,
    switches: Array,
) -> _Plan:
    keys = item.times[item.times >= item.start]
    edges, away = insets(boundaries(item, keys, lags), switches, tolerance_of(item))
    lengths = [_split(float(b - a), max_step, rng) for a, b in pairwise(edges)]
    counts = np.array([len(x) for x in lengths], dtype=np.int64)
    h = np.concatenate([*lengths, np.zeros(0)])
    t = np.concatenate([a + np.cumsum(x) - x for a, x in zip(edges[:-1], lengths, strict=True)] or [np.zeros(0)])
    arrival = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts)])
    if away.any():
        t[arrival[:-1]] += away[:-1]
        h[arrival[:-1]] -= away[:-1]
        # From the edge itself: the sum of many lengths has a larger rounding error than a step may stay away.
        last, ends = arrival[1:] - 1, (edges - away)[1:]
        h[last] = np.where(away[1:] > 0, ends - t[last], h[last])
    row_step = arrival[np.searchsorted(edges, keys)]
    kept = item.times >= item.start
    values, sd = item.values[kept], item.sd[kept]
    limits = item.censored.rows(np.flatnonzero(kept))
    weights = np.where(limits.side != 0, 1.0, weights_of(values, item.counts[kept]))
    scatter = np.zeros(values.shape) if item.scatter is None else item.scatter[kept]
    inputs, at_rows = _step_inputs(item, model, t, h, nodes), _row_inputs(item, model, keys)
    return _Plan(t, h, inputs, row_step, keys, values, weights, sd, scatter, at_rows, limits)


def _split(interval: float, max_step: float, rng: np.random.Generator | None) -> Array:
    """Lengths of an interval's sub-steps: equal, or random with none above `max_step`."""
    exact = interval / max_step
    if rng is None:
        n = max(1, int(np.ceil(exact * (1 - 1e-9))))
        return np.full(n, interval / n)
    n = max(1, int(np.ceil(1.5 * exact)))
    equal = np.full(n, 1.0 / n)
    drawn = rng.dirichlet(np.full(n, 4.0))
    excess = float(drawn.max() - 1.0 / n)
    room = max_step / interval - 1.0 / n
    blend = 1.0 if excess <= room else max(room, 0.0) / excess
    parts = equal + blend * (drawn - equal)
    return np.asarray(interval * parts / parts.sum(), dtype=np.float64)


def _step_inputs(item: Trajectory, model: Model, t: Array, h: Array, nodes: Sequence[float]) -> Array:
    out = np.zeros((len(t), len(nodes), len(model.inputs)))
    for j, (spec, signal) in enumerate(zip(model.inputs, item.inputs, strict=True)):
        middle = evaluate(signal, spec.interpolation, t + h / 2)
        for k, node in enumerate(nodes):
            if spec.interpolation == "held":
                # Breakpoints are step boundaries: a piecewise constant input equals its value at the middle.
                out[:, k, j] = middle
            else:
                out[:, k, j] = evaluate(signal, "linear", t + node * h)
    return out


def _row_inputs(item: Trajectory, model: Model, times: Array) -> Array:
    out = np.zeros((len(times), len(model.inputs)))
    for j, (spec, signal) in enumerate(zip(model.inputs, item.inputs, strict=True)):
        out[:, j] = evaluate(signal, spec.interpolation, times)
    return out
