"""Segments: trajectories cut into pieces of a few rows, each with its own initial state (multiple shooting).

Whole solutions of a long trajectory depend on a poor vector so strongly that a fit of them stops in a local minimum or
blows up. The solutions of short segments do not; yet, other than the intervals of teacher forcing, they are long enough
for an unmeasured state, or slow dynamics, to show in the measurements (Bock 1983; Ribeiro and others 2020). Initial
states of segments are free and not tied to each other.

Where the model has delays, or doses have a lag, only the beginnings of the trajectories are used: what precedes a later
segment cannot be replaced by its initial state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice, pairwise

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.data import Trajectories, Trajectory
from gbspec.ir import Model
from gbspec.training.engines import Engine, predicted
from gbspec.training.problem import Integers, Parameters
from gbspec.training.recipe.context import Context, released_starts

NOTICEABLE = 0.2
"""The first horizon is so long that measured values change by this many standard deviations in it."""
SHORTEST = 8
"""The smallest number of intervals in a segment."""
GROWTH = 2.5
"""Ratio of successive horizons."""


def horizons(context: Context, growth: float = GROWTH) -> tuple[int, ...]:
    """Numbers of intervals in the segments of successive fits, the longest trajectory's last; empty if it is too short
    to be cut."""
    most = max((len(item.times) - 1 for item in context.trajectories.items), default=0)
    found: list[int] = []
    now = float(SHORTEST)
    while now * growth**0.5 < most:
        if _changes(context, round(now)) >= NOTICEABLE or found:
            found.append(round(now))
        now *= growth
    return (*found, most) if found else ()


def _changes(context: Context, rows: int) -> float:
    """The root mean square change of measured values over `rows` rows, in units of their deviation: of the channel in
    which it is largest."""
    scale = context.problem().scaling.channel
    differences = [item.values[rows:] - item.values[:-rows] for item in context.trajectories.items]
    changes = np.concatenate([np.zeros((0, len(scale))), *differences]) / scale
    seen = np.isfinite(changes)
    squares = np.where(seen, changes, 0.0) ** 2
    return float(np.sqrt(squares.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)).max(initial=0.0))


def cut(trajectories: Trajectories, rows: int, everywhere: bool) -> tuple[Trajectories, Integers, Integers]:
    """Segments of about `rows` intervals, with the trajectory and the first row of each; neighbours share a row.

    Unless `everywhere` only the first segment of each trajectory.
    """
    items, owner, first = [], [], []
    for index, item in enumerate(trajectories.items):
        intervals = max(len(item.times) - 1, 0)
        count = max(1, round(intervals / rows))
        edges = np.linspace(0, intervals, count + 1).round().astype(int).tolist()
        for low, high in islice(pairwise(edges), None if everywhere else 1):
            items.append(_part(item, low, high + 1))
            owner.append(index)
            first.append(low)
    return replace(trajectories, items=tuple(items)), np.array(owner, np.int64), np.array(first, np.int64)


def _part(item: Trajectory, low: int, high: int) -> Trajectory:
    """Rows `low` to `high` of a trajectory, from its start if `low` is 0."""
    run_in = None if low else item.run_in
    start = item.start if low == 0 else float(item.times[low])
    doses = tuple(
        replace(d, times=d.times[d.times >= start], amounts=d.amounts[d.times >= start]) if low else d
        for d in item.doses
    )
    return replace(item.at_rows(slice(low, high)), start=start, doses=doses, run_in=run_in)


def divisible(model: Model) -> bool:
    """Whether a segment can begin at any row."""
    return not model.delays and all(dose.lag == 0 for dose in model.doses)


@dataclass(frozen=True)
class Segments:
    """The problem of segments: its engine, and for each segment its trajectory (`owner`) and first row (`first`).

    `whole` is the layout of the vector for whole trajectories.
    """

    engine: Engine
    whole: Parameters
    owner: Integers
    first: Integers

    @classmethod
    def of(cls, context: Context, whole: Parameters, rows: int) -> Segments:
        """Segments of about `rows` intervals."""
        data, owner, first = cut(context.trajectories, rows, divisible(context.model))
        free = released_starts(context.model, context.start_free, context.absent)[owner]
        value = context.start_value[owner].copy()
        for segment in np.flatnonzero(first > 0):
            at = np.array([data.items[segment].start])
            for state, curve in enumerate(context.curves.items[owner[segment]]):
                if curve is not None:
                    value[segment, state] = curve.extended(at)[0]
        absent = context.absent[owner]
        free[(first > 0)[:, None] & ~absent] = 1.0  # what the model gives are the starts of first segments
        value[absent] = 0.0
        own = replace(context, trajectories=data, start_value=value, start_free=free, absent=absent, _packed={})
        parameters = replace(whole, start_value=value, start_free=free)
        return cls(own.engine(parameters, 0.0), whole, owner, first)

    @property
    def parameters(self) -> Parameters:
        """The layout of the segments' vector."""
        return self.engine.parameters

    def vector(self, theta: Array, states: list[Array] | None) -> Array:
        """The segments' vector for a vector of whole trajectories; initial states from `states`, one table [rows,
        n_states] per trajectory, or from the curves where there is none."""
        whole, parameters = self.whole, self.parameters
        blocks = theta[whole.n_shared :].reshape(whole.trajectories, whole.n_local)[self.owner].copy()
        blocks[:, len(whole.own) :] = 0.0
        out = np.concatenate([theta[: whole.n_shared], blocks.ravel()])
        if states is None:
            return out
        starts = parameters.start_value.copy()
        for segment, (owner, row) in enumerate(zip(self.owner, self.first, strict=True)):
            if row < len(states[owner]) and np.isfinite(states[owner][row]).all():
                starts[segment] = states[owner][row]
        return parameters.with_starts(out, starts)

    def states(self, theta: Array) -> list[Array]:
        """The states at the rows of each trajectory [rows, n_states], before arrivals, at a vector of the segments."""
        before, packed = predicted(self.engine, theta).before, self.engine.problem.packed
        out = [np.zeros((0, before.shape[1])) for _ in range(self.whole.trajectories)]
        for segment, owner in enumerate(self.owner):
            rows = packed.row_table[segment, : int((packed.row_trajectory == segment).sum())]
            out[owner] = np.concatenate([out[owner][: self.first[segment]], before[rows]])
        return out

    def merged(self, theta: Array) -> Array:
        """The vector of whole trajectories: initial states of first segments, own constants averaged."""
        whole, parameters = self.whole, self.parameters
        blocks = theta[whole.n_shared :].reshape(len(self.owner), whole.n_local)
        own = np.array([blocks[self.owner == i, : len(whole.own)].mean(axis=0) for i in range(whole.trajectories)])
        out = np.zeros(whole.size)
        out[: whole.n_shared] = theta[: whole.n_shared]
        out[whole.n_shared :].reshape(whole.trajectories, whole.n_local)[:, : len(whole.own)] = own
        with torch.no_grad():
            starts = parameters.starts(torch.from_numpy(theta)).numpy()[self.first == 0]
        return whole.with_starts(out, starts)
