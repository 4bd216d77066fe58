"""Predictions of a filter several rows ahead of the measurements that it has used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gbspec.arrays import Array, Mask, as_measured
from gbspec.training.engines.filter.engine import FilterEngine
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.recursion import Moment, predicted
from gbspec.training.engines.filter.result import Filtered
from gbspec.training.problem import Integers


def steps_ahead(engine: FilterEngine, vector: Array, found: Filtered, steps: int) -> Array:
    """The prediction of each measured value [R, C] from the measurements up to `steps` rows before, in the unit of the
    channel; NaN in the rows of a trajectory that have none so early: these are predicted from its start alone."""
    theta, log_sd = engine.layout.split(vector)
    at, legs, problem = At.of(engine.layout, theta), engine.legs, engine.problem
    following = _following(engine)
    leg = np.flatnonzero(legs.row >= 0)
    moment = Moment(found.post_mean[leg], found.post_cov[leg])
    passed, leg = np.zeros(len(leg), dtype=np.int64), following[leg]
    out = np.full((problem.packed.rows, len(problem.model.channels)), np.nan)
    while True:
        going = np.flatnonzero(leg >= 0)
        if not len(going):
            return np.where((measured_before(engine, found.seen, steps) > 0)[:, None], out, np.nan)
        leg, passed = leg[going], passed[going]
        moment = Moment(moment.m[going], moment.p[going])
        moment = predicted(moment, engine.flows(at, leg, moment, shares=found.shares[leg]))
        rows = legs.row[leg]
        passed = passed + (rows >= 0)
        there = np.flatnonzero((passed == steps) & (rows >= 0))
        if len(there):
            reading = engine.readings(at, log_sd, rows[there], moment.of(there))
            out[rows[there]] = as_measured(reading.y, engine.noise.log)
        leg = np.where((passed == steps) & (rows >= 0), -1, following[leg])


def measured_before(engine: FilterEngine, seen: Mask, steps: int = 1) -> Integers:
    """How many rows of its trajectory, at least `steps` before each key row [R], have a measurement that is `seen`
    [R, C]."""
    packed, some = engine.problem.packed, np.asarray(seen.sum(axis=1) > 0, dtype=np.bool_)
    out = np.zeros(packed.rows, dtype=np.int64)
    for i in range(packed.trajectories):
        rows = np.flatnonzero(packed.row_trajectory == i)
        rows = rows[np.argsort(packed.row_index[rows])]
        out[rows[steps:]] = np.cumsum(some[rows])[: max(len(rows) - steps, 0)]
    return out


def one_row_ahead(engine: FilterEngine, found: Filtered) -> tuple[Array, Mask]:
    """Measured values minus predictions one row ahead [R, C], of logarithms where the noise is log-normal, and where
    there is such a prediction: before a trajectory's first measured row stands only the wide spread of its start, and
    an error from there says nothing of the model."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.asarray(engine.noise.value - found.mean, dtype=np.float64)
    valued = engine.problem.valued
    return errors, valued & (measured_before(engine, valued) > 0)[:, None]


def last_values(engine: FilterEngine) -> Array:
    """The value that a channel had last before each row of its trajectory [R, C], as the filter takes it (logarithms
    where the noise is log-normal); NaN before its first one."""
    packed, valued = engine.problem.packed, engine.problem.valued
    out = np.full(valued.shape, np.nan)
    for i in range(packed.trajectories):
        rows = np.flatnonzero(packed.row_trajectory == i)
        last = np.full(valued.shape[1], np.nan)
        for row in rows[np.argsort(packed.row_index[rows])]:
            out[row] = last
            last = np.where(valued[row], engine.noise.value[row], last)
    return out


def from_starts(engine: FilterEngine, vector: Array) -> Array:
    """The prediction of each value [R, C] from the start of its trajectory, without any measurement."""
    found = engine.filtered(vector, seen=np.zeros_like(engine.problem.valued))
    return as_measured(found.mean, engine.noise.log)


def _following(engine: FilterEngine) -> Integers:
    """The leg after each leg of the same trajectory [B]; -1 after the last one."""
    legs = engine.legs
    out = np.full(len(legs.owner), -1, dtype=np.int64)
    for place in range(legs.places - 1):
        here, there = legs.at(place), legs.at(place + 1)
        count = there.stop - there.start
        out[here.start : here.start + count] = np.arange(there.start, there.stop)
    return out


def with_smoothed_starts(engine: FilterEngine, found: Filtered) -> FilterEngine:
    """The engine whose unknown starts are known to be the smoothed ones: its solutions without measurements are those
    of the drift from there."""
    smoothed = engine.coordinates.states(engine.smoothed_start(found))
    start = np.where(engine.start_variance > 0, smoothed, engine.parameters.start_value)
    parameters = replace(engine.parameters, start_value=start)
    return FilterEngine(engine.problem, parameters, np.zeros_like(engine.start_variance))
