"""The filter engine: moments, the likelihood of innovations, its exact gradient and its expected information.

Flows of legs depend on the moments at their starts, which depend on all earlier ones. So the moments are guessed, all
flows are computed at the guess at once, the filter runs through these flows, and its moments are the next guess: for
the means a Newton iteration over the whole path, for the covariances one of substitution, whose fixed point is the
filter itself. After each pass at least one more leg is exact, whatever the model, and a filter forgets, so that few
passes suffice; linear models need one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import METHODS, linear_in_states
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.filter.compiled import Advance, advance
from gbspec.training.engines.filter.coordinates import Coordinates
from gbspec.training.engines.filter.costates import Costates
from gbspec.training.engines.filter.division import SHARE, Looked, Tolerance, refined, trimmed
from gbspec.training.engines.filter.exact import Exact
from gbspec.training.engines.filter.flows import Points, Stepped
from gbspec.training.engines.filter.forward import Forward, covers
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.layout import At, Layout
from gbspec.training.engines.filter.legs import Legs, legs_of, steps_of
from gbspec.training.engines.filter.local import Arrays, Local
from gbspec.training.engines.filter.noise import Noise, noise_of
from gbspec.training.engines.filter.recursion import Flow, Innovations, Moment, Reading, put, standing
from gbspec.training.engines.filter.result import Filtered, Guess, Information, Sums
from gbspec.training.engines.filter.search import Search
from gbspec.training.engines.filter.smoother import smoothed
from gbspec.training.engines.filter.values import Values, values_cover
from gbspec.training.problem import Integers, Parameters, Path, Problem

SPREAD = 1.0
"""The standard deviation of an unknown start, in typical sizes of its state (of its data, or of its range)."""
FIRST = 0.1
"""The first guess of standard deviations, in typical sizes of the states."""
NOTHING = 1e-7
"""Information of an entry below which the data say nothing of it."""
GONE = 3.0
"""A noise whose logarithm has a larger standard deviation has gone to zero."""
CHUNK = 192 * 1024**2
"""Approximate size in bytes of the derivatives that are kept at a time."""


@dataclass(frozen=True)
class FilterEngine:
    """The Kalman filter of a problem: exact where the model is linear, else with sigma points.

    `start_variance` [N, n]: the variance of each initial state, which is zero where the start is known or learned.
    """

    problem: Problem
    parameters: Parameters
    start_variance: Array

    @classmethod
    def of(cls, problem: Problem, parameters: Parameters) -> FilterEngine:
        """The engine with the default variances: those of states whose starts are neither given nor learned are
        `SPREAD` times their typical size, squared; those of logarithms are of the lognormal distribution with this
        standard deviation, and at least `SPREAD` squared, those of logits likewise, and at most of a uniform one.
        Starts without a logarithm or logit (a measured zero, or values extended to the start) are moved inside."""
        kinds = np.array([state.initial.kind for state in problem.model.states])
        free = np.where(kinds == "learned", 1.0, 0.0) * np.ones_like(parameters.start_free)
        unknown, coordinates = np.where(kinds == "measured", 1.0, 0.0), Coordinates.of_model(problem.model)
        size = SPREAD * parameters.start_scale * np.ones_like(parameters.start_value)
        value = coordinates.well_inside(parameters.start_value, size)
        variance = unknown * coordinates.spreads(value, size, SPREAD) ** 2
        return cls(problem, replace(parameters, start_free=free, start_value=value), variance)

    # ---------------------------------------------------------------- what does not depend on the vector
    @cached_property
    def coordinates(self) -> Coordinates:
        """The coordinates of the states."""
        return Coordinates.of_model(self.problem.model)

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
        values = Values(local) if values_cover(model) else None
        return Functions(local, Forward(local) if covers(model) else None, values)

    @cached_property
    def exact(self) -> Exact | None:
        """The exact legs of a linear model."""
        linear = self.functions.local.linear
        return None if linear is None else Exact(self.functions, linear)

    @cached_property
    def points(self) -> Points:
        """The moments of a model that is not linear."""
        return Points(self.functions, self.scale, METHODS[self.problem.module.solver])

    @cached_property
    def tolerance(self) -> Tolerance | None:
        """The tolerance that steps follow; None where they are fixed, or exact."""
        if self.exact is not None or self.problem.control is None:
            return None
        return Tolerance(self.problem.control, self.scale, self.coordinates.bent)

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
        """The legs of the trajectories, one for each sub-step."""
        return legs_of(self.problem)

    @cached_property
    def scale(self) -> Array:
        """The typical sizes [n] of the coordinates."""
        return np.where(self.coordinates.bent, 1.0, self.parameters.start_scale)

    @cached_property
    def _path(self) -> Path:
        return Paths(self.problem).at(self.parameters, np.zeros(self.parameters.size))

    # ---------------------------------------------------------------- flows and readings
    def flows(
        self, at: At, index: Integers, before: Moment, derivatives: bool = False, shares: Array | None = None
    ) -> Flow:
        """The flows of the legs `index` [b], at the means [b, n] and covariances at their starts; `shares` [b, K] are
        the steps in each, without which it is one step."""
        legs, width = self.legs, self.layout.width if derivatives else 0
        flow = standing(before, width if derivatives else None, self.exact is not None)
        mine = np.flatnonzero(legs.count[index] > 0)
        if not len(mine):
            return flow
        owner, here, data = self._steps(index[mine], before.of(mine))
        if self.exact is None:
            shares = np.ones((len(mine), 1)) if shares is None else trimmed(shares[mine])
            return put(flow, mine, self.points.stepped(Stepped(at, owner, data, shares, derivatives), here))
        mean, a, q = (found := self.exact.evaluate(here.m, at.k[owner], at.w, data, derivatives)).parts
        slopes = at.columns(found, owner) if derivatives else [None] * 3
        return put(flow, mine, Flow(here.m, mean, a, q, d_mean=slopes[0], d_a=slopes[1], d_q=slopes[2]))

    def _steps(self, index: Integers, before: Moment) -> tuple[Integers, Moment, Arrays]:
        """The trajectories of legs, the moments at their starts, and the data of their sub-steps."""
        owner = self.legs.owner[index]
        steps = steps_of(self._path, owner, self.legs.first[index])
        return owner, before, (steps.t, steps.h, steps.inputs, steps.doses, steps.condition)

    def readings(self, at: At, log_sd: Array, rows: Integers, before: Moment, derivatives: bool = False) -> Reading:
        """The measurements of the rows [b], at the means [b, n] and covariances there."""
        packed, noise = self.problem.packed, self.noise
        owner = packed.row_trajectory[rows]
        data = packed.row_time[rows], packed.row_inputs[rows], packed.condition[owner]
        all_r = noise.variances(log_sd)
        values = noise.value[rows], all_r[rows], self.problem.valued[rows]
        d_r = None
        if derivatives:
            d_r = np.zeros((*values[1].shape, self.layout.width))
            d_r[..., self.parameters.n_shared : self.layout.shared] = noise.slopes(all_r)[rows]
        if not self.affine:
            return self.points.read(at, owner, before, data, values, d_r)
        found = self.functions.tangent(before.m, at.k[owner], at.w, data, derivatives)
        y, c = found.parts
        d_y, d_c = at.columns(found, owner) if derivatives else (None, None)
        return Reading(before.m, y, c, *values, d_y=d_y, d_c=d_c, d_r=d_r)

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
    def filtered(
        self, vector: Array, seen: Mask | None = None, guess: Guess | None = None, held: bool = False
    ) -> Filtered:
        """The filter at a vector; with `seen` [R, C] only these measurements update the moments. `guess` are the
        moments for a vector nearby, which saves time, and its steps, which are `held`, or divided where their errors
        are beyond the tolerance."""
        search = self._search(vector, seen, guess)
        search.run(once=self.affine)
        if self.tolerance is not None and not held:
            at = At.of(self.layout, self.layout.split(vector)[0])
            looked = Looked.at_none(len(self.legs.owner), len(self.scale))
            while len(changed := self._divided(at, search.found, looked)):
                search.again(changed)
        return search.found

    def _divided(self, at: At, found: Filtered, looked: Looked) -> Integers:
        """Divides the steps in `found` whose errors are beyond the tolerance, and returns their legs. Legs that have
        been `looked` at are left out, and those after one without a finite end. Where a leg would need too many steps
        there is no solution."""
        legs, tolerance = self.legs, self.tolerance
        assert tolerance is not None
        first = np.full(len(self.start_variance), legs.places)
        np.minimum.at(first, legs.owner[found.bad], legs.place[found.bad])
        due = looked.due(found.start_mean, found.start_cov, SHARE * self.scale) | found.bad
        index = np.flatnonzero(due & (legs.count > 0) & (legs.place <= first[legs.owner])).astype(np.int64)
        if not len(index):
            return index
        owner, here, data = self._steps(index, found.moments(index))
        old = trimmed(found.shares[index])
        errors = self.points.errors(Stepped(at, owner, data, old, False), here, tolerance)
        new = refined(old, errors)
        good = ~(errors > 1).any(axis=1)
        looked.put(index[good], here.m[good], here.p[good])
        more = (new > 0).sum(axis=1) > (old > 0).sum(axis=1)
        lost = ~good & ~more
        if lost.any():
            found.lost(index[lost])
            return index[:0]
        changed: Integers = index[more]
        found.divide(changed, new[more])
        return changed

    def linearised(self, vector: Array, moments: Guess, seen: Mask) -> Filtered:
        """The filter of the linear model that fits this one best at given moments."""
        search = self._search(vector, seen, moments)
        search.run(once=True)
        return search.found

    def _search(self, vector: Array, seen: Mask | None, guess: Guess | None) -> Search:
        """The search of the moments at a vector, from a guess."""
        theta, log_sd = self.layout.split(vector)
        at = At.of(self.layout, theta)
        start = self.start(at)
        rows, channels = self.noise.value.shape
        found = Filtered.empty(len(self.legs.owner), len(self.scale), rows, channels, self.noise.log)
        if guess is not None and all(np.isfinite(table).all() for table in guess):
            found.start_mean[:], found.start_cov[:], found.end_mean[:], found.end_cov[:], found.shares = guess
        else:
            begin = np.where(np.isfinite(start.m), start.m, 0.0)[self.legs.owner]
            found.start_mean[:] = np.where(np.isfinite(self._first), self._first, begin)
            found.end_mean[:] = found.start_mean
            found.start_cov[:] = found.end_cov[:] = np.diag((FIRST * self.scale) ** 2)
        used = self.problem.valued if seen is None else seen

        def flows(index: Integers, before: Moment) -> Flow:
            return self.flows(at, index, before, shares=found.shares[index])

        def readings(rows: Integers, before: Moment) -> Reading:
            return replace(self.readings(at, log_sd, rows, before), seen=used[rows])

        return Search(self.legs, self.scale, flows, readings, self.advance, start, used, found)

    @cached_property
    def _first(self) -> Array:
        """A first guess of the coordinates at the start of each leg."""
        return self.coordinates.of(_first_states(self))

    def value(self, vector: Array) -> float:
        """The negative log likelihood; infinite where the solution is not finite."""
        return self.filtered(vector).value

    def information(self, vector: Array, found: Filtered | None = None) -> Information:
        """The negative log likelihood at a vector with its gradient and expected information; `found` is the filter
        there, if it is known."""
        found = self.filtered(vector) if found is None else found
        if not found.finite:
            return Information.none(self.layout)
        sums = Sums(self.layout)
        for rows, _, readings, innovations in self._sensitivities(vector, found):
            sums.add(self.problem.packed.row_trajectory[rows], innovations, readings.seen)
        return sums.information(found.value)

    def information_change(self, vector: Array, found: Filtered, factor: Array, entries: Integers) -> Array:
        """The derivatives [m] of trace(F' H F) along the `entries`, which are sizes of disturbances and noises, for a
        `factor` F [size, p] and the information H of means in the linear model that the filter has found."""
        costates = Costates(self.layout, self.legs, found, entries, factor)
        for rows, flows, readings, innovations in self._sensitivities(vector, found):
            costates.add(self.problem.packed.row_trajectory[rows], flows, readings, innovations)
        return costates.change(self.start(At.of(self.layout, self.layout.split(vector)[0]), True))

    def _sensitivities(self, vector: Array, found: Filtered) -> Iterator[tuple[Integers, Flow, Reading, Innovations]]:
        """Chunks of legs at the filter's moments, all with derivatives: the rows at their ends, flows, readings, and
        innovations."""
        theta, log_sd = self.layout.split(vector)
        at, legs = At.of(self.layout, theta), self.legs
        moment = self.start(at, True)
        for chunk in self._chunks():
            index = np.arange(chunk.start, chunk.stop)
            before = Moment(found.start_mean[index], found.start_cov[index])
            flows = self.flows(at, index, before, True, found.shares[index])
            rows, place = legs.rows_of(index)
            ends = index[place >= 0]
            readings = self.readings(at, log_sd, rows, Moment(found.end_mean[ends], found.end_cov[ends]), True)
            readings = replace(readings, seen=found.seen[rows])
            yield rows, flows, readings, self.advance(moment, legs.owner[index], flows, readings, place, None)

    # ---------------------------------------------------------------- what follows from a filter
    def ended(self, vector: Array, deviations: Array) -> Mask:
        """The entries [size] of a vector with these standard deviations that ended at a bound: constants that
        trajectories share, and noises at zero. Nothing changes any more with them."""
        parameters, out = self.parameters, np.zeros(len(vector), dtype=np.bool_)
        places = slice(parameters.n_weights, parameters.n_shared)
        out[places] = parameters.bijections(parameters.shared).ended(vector[places], deviations[places])
        out[parameters.size :] = deviations[parameters.size :] > GONE
        return out

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
        both = n + n * n
        # Derivatives of the flows and readings, and of the values at the points from which they are computed.
        columns = self.layout.width + (0 if self.exact is not None else both)
        each = 8 * columns * (2 * both + channels * (n + 2) + (0 if self.exact is not None else 8 * n * (2 * n + 1)))
        begin = 0
        while begin < legs.places:
            end = begin + 1
            while end < legs.places and (legs.begins[end + 1] - legs.begins[begin]) * each <= CHUNK:
                end += 1
            yield slice(int(legs.begins[begin]), int(legs.begins[end]))
            begin = end


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


__all__ = ["GONE", "FilterEngine", "Filtered", "Guess", "Information", "Innovations"]
