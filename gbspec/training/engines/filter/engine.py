"""The filter engine: moments, the likelihood of innovations, its exact gradient and its expected information.

Flows of legs depend on the mean at their starts, which depends on all earlier ones. So the means are guessed, all flows
are linearised at the guess at once, the filter runs through these linear flows, and its means are the next guess: a
Newton iteration over the whole path, whose fixed point is the extended Kalman filter itself. After each pass at least
one more row is exact, whatever the model, and a filter forgets, so that a few passes suffice; linear models need one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import linear_in_states
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.filter.compiled import Advance, advance
from gbspec.training.engines.filter.composed import whole_legs
from gbspec.training.engines.filter.coordinates import Coordinates, relative_states
from gbspec.training.engines.filter.exact import Exact
from gbspec.training.engines.filter.forward import Forward, covers
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.layout import At, Layout
from gbspec.training.engines.filter.legs import Legs, buckets, legs_of, steps_of
from gbspec.training.engines.filter.local import Local
from gbspec.training.engines.filter.noise import Noise, noise_of
from gbspec.training.engines.filter.recursion import Flow, Innovations, Kept, Moment, Reading
from gbspec.training.engines.filter.result import Filtered, Information, Sums
from gbspec.training.engines.filter.smoother import smoothed
from gbspec.training.problem import Integers, Parameters, Path, Problem

SPREAD = 1.0
"""The standard deviation of an unknown start, in typical sizes of its state (of its data, or of its range)."""
TOLERANCE = 1e-11
"""The guess of the means is exact when it moves by less, in typical sizes of the states."""
PASSES, WINDOW = 25, 16
"""After this many passes over all rows the rest is done in windows of this many places, which cannot take longer than
one place after the other."""
NOTHING = 1e-7
"""Information of an entry below which the data say nothing of it."""
CHUNK = 192 * 1024**2
"""Approximate size in bytes of the derivatives that are kept at a time."""

Means = tuple[Array, Array]
"""The means [B, n] at the starts and ends of legs."""


@dataclass(frozen=True)
class FilterEngine:
    """The extended Kalman filter of a problem.

    `start_variance` [N, n]: the variance of each initial state, which is zero where the start is known or learned.
    """

    problem: Problem
    parameters: Parameters
    start_variance: Array

    @classmethod
    def of(cls, problem: Problem, parameters: Parameters) -> FilterEngine:
        """The engine with the default variances: those of states whose starts are neither given nor learned are
        `SPREAD` times their typical size, squared, and those of logarithms at least `SPREAD` squared."""
        kinds = np.array([state.initial.kind for state in problem.model.states])
        free = np.where(kinds == "learned", 1.0, 0.0) * np.ones_like(parameters.start_free)
        unknown = np.where(kinds == "measured", 1.0, 0.0)
        own = np.where(relative_states(problem.model), np.abs(parameters.start_value), 0.0)
        variance = unknown * (SPREAD * np.maximum(parameters.start_scale, own)) ** 2 * np.ones_like(free)
        return cls(problem, replace(parameters, start_free=free), variance)

    # ---------------------------------------------------------------- what does not depend on the vector
    @cached_property
    def coordinates(self) -> Coordinates:
        """The coordinates of the states."""
        return Coordinates(relative_states(self.problem.model))

    @cached_property
    def noise(self) -> Noise:
        """The measurements and what is known of their noise."""
        return noise_of(self.problem)

    @cached_property
    def layout(self) -> Layout:
        """The vector of the likelihood."""
        return Layout(self.parameters, len(self.noise.learned))

    @cached_property
    def functions(self) -> Functions:
        """The functions of legs and rows."""
        model = self.problem.model
        local = Local(self.problem, self.parameters, self.coordinates, self.noise.log, linear_in_states(model))
        return Functions(local, Forward(local) if covers(model) else None)

    @cached_property
    def exact(self) -> Exact | None:
        """The exact legs of a linear model."""
        linear = self.functions.local.linear
        return None if linear is None else Exact(self.functions, linear)

    @cached_property
    def advance(self) -> Advance:
        """The recursion over legs."""
        return advance()

    @property
    def affine(self) -> bool:
        """Whether flows and readings are the same at any coordinates, so that one pass is exact."""
        return self.exact is not None and self.exact.linear.observed and not self.noise.log.any()

    @cached_property
    def legs(self) -> Legs:
        """The legs of the trajectories."""
        return legs_of(self.problem, self.exact is not None)

    @cached_property
    def scale(self) -> Array:
        """The typical sizes [n] of the coordinates."""
        return np.where(self.coordinates.log, 1.0, self.parameters.start_scale)

    @cached_property
    def _path(self) -> Path:
        return Paths(self.problem).at(self.parameters, np.zeros(self.parameters.size))

    # ---------------------------------------------------------------- flows and readings
    def flows(self, at: At, index: Integers, z: Array, derivatives: bool = False) -> Flow:
        """The flows of the legs `index` [b], linearised at their coordinates `z` [b, n]."""
        legs, n, width = self.legs, z.shape[1], self.layout.width
        mean, a, q = z.copy(), np.tile(np.eye(n), (len(z), 1, 1)), np.zeros((len(z), n, n))
        d_mean, d_a, d_q = (np.zeros((len(z), *shape, width if derivatives else 0)) for shape in ((n,), (n, n), (n, n)))
        moving = derivatives and self.exact is None
        a_state, q_state = (np.zeros((len(z) if moving else 0, n, n, n)) for _ in range(2))
        for depth, mine in buckets(legs.count[index]):
            if not depth:
                continue
            chosen = index[mine]
            steps = steps_of(self._path, legs.owner[chosen], legs.first[chosen], legs.count[chosen], depth)
            data = (steps.t, steps.h, steps.inputs, steps.doses, steps.condition)
            here, k = z[mine], at.k[legs.owner[chosen]]
            if self.exact is not None:
                found = self.exact.evaluate(here, k, at.w, data, derivatives)
                mean[mine], a[mine], q[mine] = found.parts
                if derivatives:
                    d_mean[mine], d_a[mine], d_q[mine] = at.columns(found, legs.owner[chosen])
                continue
            (mean[mine], a[mine], q[mine]), starts = self.functions.moved(here, k, at.w, data)
            if derivatives:
                leg = whole_legs(self.functions, at, legs.owner[chosen], starts, data)
                d_mean[mine], d_a[mine], d_q[mine], a_state[mine], q_state[mine] = leg
        if not derivatives:
            return Flow(z, mean, a, q)
        return Flow(z, mean, a, q, a_state if moving else None, q_state if moving else None, d_mean, d_a, d_q)

    def readings(self, at: At, log_sd: Array, rows: Integers, z: Array, derivatives: bool = False) -> Reading:
        """The measurements of the rows [b], linearised at the coordinates `z` [b, n]."""
        packed, noise = self.problem.packed, self.noise
        owner = packed.row_trajectory[rows]
        data = packed.row_time[rows], packed.row_inputs[rows], packed.condition[owner]
        variance = noise.variances(log_sd)[rows]
        found = self.functions.observation(z, at.k[owner], at.w, data, derivatives)
        y, c = found.parts
        plain = Reading(z, y, c, noise.value[rows], variance, self.problem.valued[rows])
        if not derivatives:
            return plain
        d_y, d_c = at.columns(found, owner)
        d_r = np.zeros((*variance.shape, self.layout.width))
        d_r[..., self.parameters.n_shared : self.layout.shared] = noise.slopes(noise.variances(log_sd))[rows]
        return replace(plain, c_state=found.by_state[1], d_y=d_y, d_c=d_c, d_r=d_r)

    def start(self, at: At, derivatives: bool = False) -> Moment:
        """The moments at the starts of the trajectories."""
        packed, layout = self.problem.packed, self.layout
        found = self.functions.start(at.starts, at.k, at.w, (self.start_variance, packed.condition), derivatives)
        m, p = (part.copy() for part in found.parts)
        if not derivatives:
            return Moment(m, p)
        dm, dp = at.columns(found, np.arange(packed.trajectories))
        begin = layout.shared + len(self.parameters.own)
        for table, part in zip((dm, dp), found.by_state, strict=True):
            by_start = part * at.start_slopes
            free = self.parameters.start_free.reshape(len(m), *(1,) * (table.ndim - 2), -1)
            table[..., begin:] = (by_start * free)[..., layout.states]
        return Moment(m, p, dm, dp)

    # ---------------------------------------------------------------- the filter
    def filtered(self, vector: Array, seen: Mask | None = None, guess: Means | None = None) -> Filtered:
        """The filter at a vector; with `seen` [R, C] only these measurements update the moments. `guess` are the means
        at the starts and ends of legs for a vector nearby, which saves time."""
        theta, log_sd = self.layout.split(vector)
        return _Search(self, At.of(self.layout, theta), log_sd, seen, guess).run()

    def linearised(self, vector: Array, means: Means, seen: Mask) -> Filtered:
        """The filter of the model that is linear around given means at the starts and ends of legs."""
        theta, log_sd = self.layout.split(vector)
        return _Search(self, At.of(self.layout, theta), log_sd, seen, means).once()

    def value(self, vector: Array) -> float:
        """The negative log likelihood; infinite where the solution is not finite."""
        return self.filtered(vector).value

    def information(self, vector: Array, found: Filtered | None = None) -> Information:
        """The negative log likelihood at a vector with its gradient and expected information; `found` is the filter
        there, if it is known."""
        theta, log_sd = self.layout.split(vector)
        found = self.filtered(vector) if found is None else found
        if not found.finite:
            return Information.none(self.layout)
        at, legs, sums = At.of(self.layout, theta), self.legs, Sums(self.layout)
        moment = self.start(at, True)
        for chunk in self._chunks():
            index = np.arange(chunk.start, chunk.stop)
            flows = self.flows(at, index, found.start_mean[index], True)
            rows, place = _rows_of(legs, index)
            readings = self.readings(at, log_sd, rows, found.end_mean[index[place >= 0]], True)
            readings = replace(readings, seen=found.seen[rows])
            innovations = self.advance(moment, legs.owner[index], flows, readings, place, None)
            sums.add(self.problem.packed.row_trajectory[rows], innovations, readings.seen)
        return sums.information(found.value)

    # ---------------------------------------------------------------- what follows from a filter
    def deviations(self, vector: Array, found: Filtered) -> Array:
        """The standard deviations of the vector's entries, from the information; NaN where there is none."""
        matrix = self.information(vector, found).matrix
        size = np.diag(matrix)
        scale = np.where(size > 0, 1 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)
        inverse = np.linalg.pinv(matrix * np.outer(scale, scale), rcond=1e-13, hermitian=True)
        return np.where(size > 0, scale * np.sqrt(np.maximum(np.diag(inverse), 0.0)), np.nan)

    def draws(self, vector: Array, found: Filtered, count: int) -> Array:
        """Vectors [count, size] that the data may have come from as well: normal, with the inverse of the information
        as covariance, weights with the precision of their prior (their number over their squares). What the data say
        nothing of stays."""
        matrix, weights = self.information(vector, found).matrix, vector[: self.parameters.n_weights]
        known = (np.diag(matrix) > NOTHING) & (self.layout.free > 0)
        if len(weights):
            places = np.arange(len(weights))
            matrix[places, places] += len(weights) / max(float(weights @ weights), 1e-12)
        block = matrix[np.ix_(known, known)]
        scale = 1 / np.sqrt(np.diag(block))
        values, axes = np.linalg.eigh(block * np.outer(scale, scale))
        roots = np.where(values > 1e-10, 1 / np.sqrt(np.maximum(values, 1e-10)), 0.0)
        normal = np.random.default_rng(0).standard_normal((count, int(known.sum())))
        out = np.tile(vector, (count, 1))
        out[:, known] += scale * ((normal * roots) @ axes.T)
        return out

    def standardised(self, found: Filtered, channel: int) -> list[Array]:
        """A channel's errors in standard deviations, in the order of time, for each trajectory."""
        packed, seen = self.problem.packed, self.problem.valued[:, channel]
        out = []
        for i in range(packed.trajectories):
            rows = np.flatnonzero(seen & (packed.row_trajectory == i))
            rows = rows[np.argsort(packed.row_index[rows])]
            out.append(found.error[rows, channel] / np.sqrt(found.variance[rows, channel]))
        return out

    def smoothed_start(self, found: Filtered) -> Array:
        """The smoothed coordinates at the starts of the trajectories [N, n]."""
        *_, start, _ = smoothed(found, self.legs)
        out = np.zeros_like(self.start_variance)
        if self.legs.places:
            first = self.legs.at(0)
            out[self.legs.owner[first]] = start[first]
        return out

    def row_states(self, found: Filtered) -> tuple[Array, Array]:
        """The states at the key rows [R, n] before and after their measurements."""
        before, after = (np.full((self.problem.packed.rows, len(self.scale)), np.nan) for _ in range(2))
        ends = np.flatnonzero(self.legs.row >= 0)
        before[self.legs.row[ends]] = self.coordinates.states(found.end_mean[ends])
        after[self.legs.row[ends]] = self.coordinates.states(found.post_mean[ends])
        return before, after

    def _chunks(self) -> Iterator[slice]:
        """Legs of successive places whose derivatives fit into memory."""
        n, legs = len(self.problem.model.states), self.legs
        channels = len(self.problem.model.channels)
        each = 8 * self.layout.width * (n + 2 * n * n + channels * (n + 2))
        begin = 0
        while begin < legs.places:
            end = begin + 1
            while end < legs.places and (legs.begins[end + 1] - legs.begins[begin]) * each <= CHUNK:
                end += 1
            yield slice(int(legs.begins[begin]), int(legs.begins[end]))
            begin = end


class _Search:
    """The search of the means at one vector."""

    def __init__(self, engine: FilterEngine, at: At, log_sd: Array, seen: Mask | None, near: Means | None) -> None:
        self.engine, self.at, self.log_sd = engine, at, log_sd
        self.legs, problem = engine.legs, engine.problem
        n, count = len(problem.model.states), len(engine.legs.owner)
        self.seen = problem.valued if seen is None else seen
        self.start = engine.start(at)
        self.first = engine.coordinates.of(_first_states(engine))
        self.found = Filtered.empty(count, n, problem.packed.rows, len(problem.model.channels), engine.noise.log)
        finite = np.where(np.isfinite(self.start.m), self.start.m, 0.0)
        guess = np.where(np.isfinite(self.first), self.first, finite[self.legs.owner])
        self.found.start_mean[:], self.found.end_mean[:] = guess, guess
        if near is not None and all(np.isfinite(table).all() for table in near):
            self.found.start_mean[:], self.found.end_mean[:] = near

    def run(self) -> Filtered:
        """The filter's moments where the guess is exact."""
        legs, found, place, window = self.legs, self.found, 0, self.legs.places
        passes = 0
        while place < legs.places:
            end = min(place + window, legs.places)
            place = self._pass(place, end)
            passes += 1
            if self.engine.affine:
                break
            if passes > PASSES:
                window = WINDOW
        found.finish(self.seen)
        return found

    def once(self) -> Filtered:
        """The moments with everything linearised at the guess."""
        self._pass(0, self.legs.places)
        self.found.finish(self.seen)
        return self.found

    def _pass(self, begin: int, end: int) -> int:
        """One pass over the places from `begin` to `end`; the first place whose guess was not exact."""
        engine, legs, found = self.engine, self.legs, self.found
        index = np.arange(legs.begins[begin], legs.begins[end])
        flows = _sound(engine.flows(self.at, index, found.start_mean[index]), found.bad, index)
        rows, place = _rows_of(legs, index)
        z = found.end_mean[index[place >= 0]]
        readings = replace(engine.readings(self.at, self.log_sd, rows, z), seen=self.seen[rows])
        guesses = found.start_mean[index], found.end_mean[index]
        moment = Moment(self.start.m.copy(), self.start.p.copy()) if begin == 0 else self._stored(begin)
        kept = Kept.empty(len(index), len(engine.scale))
        innovations = engine.advance(moment, legs.owner[index], flows, readings, place, kept)
        found.put(index, kept, flows.a, rows, innovations)
        moved = _moved(found.start_mean[index], guesses[0], engine.scale)
        moved |= (place >= 0) & _moved(found.end_mean[index], guesses[1], engine.scale)
        if not moved.any():
            return end
        return int(np.searchsorted(legs.begins, index[np.argmax(moved)], side="right")) - 1

    def _stored(self, place: int) -> Moment:
        """The moments of all trajectories at the ends of the place before; of those that have ended, any."""
        owner, span = self.legs.owner, self.legs.at(place - 1)
        moment = Moment(self.start.m.copy(), self.start.p.copy())
        moment.put(owner[span], Moment(self.found.post_mean[span], self.found.post_cov[span]))
        return moment


def _rows_of(legs: Legs, index: Integers) -> tuple[Integers, Integers]:
    """The rows at the ends of legs that have one, and the place of each leg's row among them (-1: none)."""
    ends = np.flatnonzero(legs.row[index] >= 0)
    place = np.full(len(index), -1, dtype=np.int64)
    place[ends] = np.arange(len(ends))
    return legs.row[index[ends]], place


def _moved(new: Array, old: Array, scale: Array) -> Mask:
    """Which guesses [B, n] differ from what they led to [B]; what is not finite cannot get better."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(new - old) > TOLERANCE * (scale + np.abs(new))).any(axis=1), dtype=np.bool_)


def _sound(flows: Flow, bad: Mask, index: Integers) -> Flow:
    """The flows, with those that are not finite replaced by standing still, and marked."""
    parts = (flows.mean, flows.a.reshape(len(index), -1), flows.q.reshape(len(index), -1))
    wrong = ~np.all([np.isfinite(part).all(axis=1) for part in parts], axis=0)
    bad[index] = wrong
    if not wrong.any():
        return flows
    mean, a, q = flows.mean.copy(), flows.a.copy(), flows.q.copy()
    mean[wrong], a[wrong], q[wrong] = flows.at[wrong], np.eye(mean.shape[1]), 0.0
    return Flow(flows.at, mean, a, q)


def _first_states(engine: FilterEngine) -> Array:
    """A first guess of the states at the start of each leg [B, n]: the last measured values, NaN without any."""
    from gbspec.training.problem import measured_states

    problem, legs = engine.problem, engine.legs
    values, seen = measured_states(problem.model, problem.packed)
    last = np.full((problem.packed.trajectories, values.shape[1]), np.nan)
    out = np.full((len(legs.owner), values.shape[1]), np.nan)
    for place in range(legs.places):
        span = legs.at(place)
        owner, row = legs.owner[span], legs.row[span]
        out[span] = last[owner]
        some = row >= 0
        here = values[row[some]]
        last[owner[some]] = np.where(seen[row[some]], here, last[owner[some]])
    return out


__all__ = ["FilterEngine", "Filtered", "Information", "Innovations"]
