"""The filter of a finished run on a table: states as measurements show them, and predictions ahead of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array, Mask, as_measured
from gbspec.backends import GeneratedModule
from gbspec.data import Trajectories, continued, fingerprint
from gbspec.training.engines import Filtered, FilterEngine, Whiteness, filter, whiteness
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Integers
from gbspec.training.recipe import build_context

if TYPE_CHECKING:
    from gbspec.runs import Covariance, Run


_Coordinates = tuple[Array, Array, Array, Array]
"""Coordinates [R, n] and their covariances [R, n, n], channels [R, C] and the variances of new measurements."""
_Path = Callable[[Array, Filtered], _Coordinates]
_Variances = tuple[Array, Array]

PAIRS = 16
"""The most pairs of displaced constants; up to so many constants the variance is that of the linearised model."""
SHORTENED = 0.1
"""The differences are of so many standard deviations, so that they are nearly linear and far above the tolerance to
which smoothed states are iterated."""


@dataclass(frozen=True)
class RowMoments:
    """A trajectory's rows [R]: means and standard deviations of its states [R, n], where `log` [n] of their logarithms,
    and of a new measurement of each channel [R, C], where `log_channels` [C] of its logarithm."""

    states: Array
    state_sd: Array
    channels: Array
    channel_sd: Array
    log: Mask
    log_channels: Mask

    @property
    def measurement_sd(self) -> Array:
        """The standard deviations of new measurements [R, C] in the channels' units."""
        return np.where(self.log_channels, self.channel_sd * np.abs(self.channels), self.channel_sd)


@dataclass(frozen=True)
class FilteredRun:
    """A member's filter on a table, with the measurements that it used."""

    engine: FilterEngine
    vector: Array
    found: Filtered

    @property
    def finite(self) -> bool:
        """Whether all moments are."""
        return self.found.finite

    def ahead(self, steps: int | None) -> list[Array]:
        """The predictions [R, C] of each trajectory's rows from the measurements `steps` rows before; None: from its
        (smoothed) start alone."""
        if steps is None:
            engine = filter.with_smoothed_starts(self.engine, self.found)
            return self._by_trajectory(filter.from_starts(engine, self.vector))
        return self._by_trajectory(filter.steps_ahead(self.engine, self.vector, self.found, steps))

    def standardised(self, channel: int) -> list[Array]:
        """A channel's errors of predictions, in their standard deviations, trajectory by trajectory."""
        return self.engine.standardised(self.found, channel)

    def whiteness(self, channel: int) -> Whiteness | None:
        """The tests of a channel's innovations."""
        return whiteness(self.standardised(channel)) if self.finite else None

    def smoothed(self, draws: int = 0, training: FilteredRun | None = None) -> list[RowMoments]:
        """States and channels at the rows of each trajectory as all used measurements show them. The standard
        deviations contain the uncertainty of the fitted parameters as `draws` of them show it: of those that the
        measurements used here leave open, or of the shared ones that those of `training`, other trajectories, do."""
        return self._moments(self._path, self._of_draws(self._path, draws, training))

    def smoothed_after(self, training: Covariance) -> list[RowMoments]:
        """The same with the uncertainty of the constants that the fit to other data has left."""
        return self._moments(self._path, self._of_constants(self._path, training))

    def one_ahead(self, draws: int = 0, training: FilteredRun | None = None) -> list[RowMoments]:
        """The same as `smoothed` as the measurements before each row show them; NaN in the first rows."""
        return self._moments(self._before, self._of_draws(self._before, draws, training))

    def one_ahead_after(self, training: Covariance) -> list[RowMoments]:
        """The same with the uncertainty of the constants that the fit to other data has left."""
        return self._moments(self._before, self._of_constants(self._before, training))

    def states_ahead(self) -> list[Array]:
        """The states [R, n] at the rows of each trajectory as the measurements before each row show them, in steps as
        they were taken; NaN in first rows."""
        before = self.engine.row_states(self.found)[0]
        return [np.where(np.arange(len(mine))[:, None] > 0, before[mine], np.nan) for mine in self._rows]

    def _of_draws(self, path: _Path, draws: int, training: FilteredRun | None) -> _Variances | None:
        """The variances of coordinates [R, n] and channels [R, C] over parameters that the data may have come from."""
        source = self if training is None else training
        if not draws or not self.finite or not source.finite:
            return None
        engine, seen = self.engine, self.found.seen
        vectors = source.engine.draws(source.vector, source.found, draws)
        if training is not None:
            shared = slice(engine.parameters.n_shared)
            changes, vectors = vectors - training.vector, np.tile(self.vector, (draws, 1))
            vectors[:, shared] += changes[:, shared]
        found = [(each, engine.filtered(each, seen)) for each in vectors]
        paths = [path(each, one)[0::2] for each, one in found if one.finite]
        if len(paths) < 2:
            return None
        z, y = (np.var(np.array(tables), axis=0, ddof=1) for tables in zip(*paths, strict=True))
        return z, y

    def _of_constants(self, path: _Path, training: Covariance) -> _Variances | None:
        """The same by differences along the columns of a square root of a covariance of shared constants."""
        parameters, squares = self.engine.parameters, []
        places = slice(parameters.n_weights, parameters.n_shared)
        slopes = parameters.bijections(parameters.shared).derivative(self.vector[places])
        names = [parameters.model.learnables[i].name for i in parameters.shared]
        for _, constants in training.displacements(np.random.default_rng(67), PAIRS) if self.finite else []:
            by = dict(zip(training.constants, constants, strict=True))
            change = np.zeros(len(self.vector))
            shifts = SHORTENED * np.array([by.get(name, 0.0) for name in names])
            change[places] = np.divide(shifts, slopes, out=np.zeros_like(shifts), where=slopes > 0)  # 0: at a bound
            ends = [self.vector + change, self.vector - change]
            found = [self.engine.filtered(end, self.found.seen) for end in ends]
            if all(one.finite for one in found):
                up, down = (path(end, one)[0::2] for end, one in zip(ends, found, strict=True))
                squares.append([((a - b) / (2 * SHORTENED)) ** 2 for a, b in zip(up, down, strict=True)])
        if not squares:
            return None
        z, y = (np.mean(np.array(tables), axis=0) for tables in zip(*squares, strict=True))
        return z, y

    def _moments(self, path: _Path, between: _Variances | None) -> list[RowMoments]:
        engine, log, log_y = self.engine, self.engine.coordinates.log, self.engine.noise.log
        z, p, y, variance = path(self.vector, self.found)
        variances = np.diagonal(p, axis1=1, axis2=2), variance
        if between is not None:
            variances = variances[0] + between[0], variances[1] + between[1]
        sd, spread = (np.sqrt(np.maximum(each, 0.0)) for each in variances)
        states = engine.coordinates.states(z)
        sd = np.where(log, sd, sd / engine.coordinates.slopes(states))
        channels = as_measured(y, log_y)
        return [RowMoments(states[mine], sd[mine], channels[mine], spread[mine], log, log_y) for mine in self._rows]

    def _path(self, vector: Array, found: Filtered) -> _Coordinates:
        """Smoothed coordinates [R, n] at the rows with their covariances, and predicted channels [R, C] with the
        variances of new measurements, at a vector."""
        mean, cov, *_ = filter.iterated(self.engine, vector, found)
        return self._at_rows(vector, mean, cov)

    def _before(self, vector: Array, found: Filtered) -> _Coordinates:
        """The same before the measurements of each row."""
        z, p, y, variance = self._at_rows(vector, found.end_mean, found.end_cov)
        first = self.engine.problem.packed.row_index == 0
        y[first], variance[first] = np.nan, np.nan
        return z, p, y, variance

    def _at_rows(self, vector: Array, mean: Array, cov: Array) -> _Coordinates:
        """The moments [B, n] and [B, n, n] of the legs that end in rows, and what is measured there."""
        legs, n = self.engine.legs, mean.shape[1]
        ends = np.flatnonzero(legs.row >= 0)
        z = np.zeros((self.engine.problem.packed.rows, n))
        p = np.zeros((len(z), n, n))
        z[legs.row[ends]], p[legs.row[ends]] = mean[ends], cov[ends]
        return z, p, *self._read(vector, z, p)

    def _read(self, vector: Array, z: Array, p: Array) -> tuple[Array, Array]:
        """Predicted channels [R, C] and the variances of new measurements."""

        theta, log_sd = self.engine.layout.split(vector)
        at, every = filter.At.of(self.engine.layout, theta), np.arange(len(z), dtype=np.int64)
        reading = self.engine.readings(at, log_sd, every, filter.Moment(z, p))
        own = self.engine.noise.variances(log_sd)
        seen = self.engine.problem.valued
        # Cells without a measurement have no variance of their own: the usual one of the channel stands for it.
        usual = np.array([np.median(own[seen[:, i], i]) if seen[:, i].any() else 0.0 for i in range(own.shape[1])])
        spread = np.einsum("rci,rij,rcj->rc", reading.c, p, reading.c)
        return reading.y, np.maximum(spread, 0.0) + np.where(own > 0, own, usual)

    @property
    def longest_step(self) -> float:
        """The longest step that was taken; 0 without any."""
        return float(self.engine.problem.packed.h.max(initial=0.0))

    @cached_property
    def _rows(self) -> list[Integers]:
        packed = self.engine.problem.packed
        found = [np.flatnonzero(packed.row_trajectory == i) for i in range(packed.trajectories)]
        return [rows[np.argsort(packed.row_index[rows])] for rows in found]

    def _by_trajectory(self, table: Array) -> list[Array]:
        return [table[rows] for rows in self._rows]


def filter_run(
    run: Run,
    trajectories: Trajectories,
    member: int,
    window: int | Sequence[int] | None = None,
    hidden: Sequence[Mask] | None = None,
    max_step: float | None = None,
) -> FilteredRun:
    """A member's filter on a table; with `window` only the first so many measured rows of each trajectory are used (a
    number for all or for each of them), and none that are `hidden` (for each trajectory a mask of its rows).
    `max_step`: its largest step, else the fit's."""
    instance, record = run.member(member), run.fit.members[run.numbers.index(member)]
    step = run.filter_step(member) if max_step is None else max_step
    tolerance = run.tolerance(member)
    options = TrainOptions(backend="torch", device="cpu", max_step=step, solver=run.fit.solver, tolerance=tolerance)
    context = build_context(run.model, run.module, trajectories, options, 0)
    context.module = instance
    fixed = {k: v for k, v in instance.weights.items() if k.endswith(("_center", "_scale"))}
    shown, guess = context, context.start_value
    if hidden is not None:
        visible = _without(trajectories, hidden)
        shown = build_context(run.model, run.module, visible, options, 0)
        guess = _middles(run, visible, hidden, guess)
    starts, constants = _known(run, instance, trajectories, guess, window is None)
    parameters = replace(shown.parameters(fixed), start_value=starts)
    engine = FilterEngine.of(context.problem(0.0), parameters)
    noise = {} if record.likelihood is None else record.likelihood.noise
    log_sd, channels = engine.noise.first(), run.model.channels
    for place, channel in enumerate(engine.noise.learned):
        known = noise.get(channels[channel].name)
        log_sd[place] = log_sd[place] if known is None else np.log(max(known.value, 1e-300))
    vector = np.concatenate([parameters.vector(instance.weights, constants), log_sd])
    seen = engine.problem.valued
    if window is not None:
        most = np.broadcast_to(np.asarray(window, dtype=np.int64), (len(trajectories),))
        early = filter.measured_before(engine, engine.problem.valued) < most[engine.problem.packed.row_trajectory]
        seen = seen & early.reshape(-1, 1)
    if hidden is not None:
        masks = [mask[item.times >= item.start] for item, mask in zip(trajectories.items, hidden, strict=True)]
        packed = engine.problem.packed
        seen = seen.copy()
        for i, mask in enumerate(masks):
            rows = np.flatnonzero(packed.row_trajectory == i)
            seen[rows[np.argsort(packed.row_index[rows])][mask]] = False
    return FilteredRun(engine, vector, engine.filtered(vector, seen=seen))


def _without(trajectories: Trajectories, hidden: Sequence[Mask]) -> Trajectories:
    """The trajectories without the values of hidden rows."""
    pairs = zip(trajectories.items, hidden, strict=True)
    items = (replace(item, values=np.where(mask[:, None], np.nan, item.values)) for item, mask in pairs)
    return replace(trajectories, items=tuple(items))


def _middles(run: Run, visible: Trajectories, hidden: Sequence[Mask], start: Array) -> Array:
    """Guesses of the starts [N, n]: of a measured state whose first row is hidden, the median of the other values,
    around which there is a wide prior."""
    out = start.copy()
    for i, (item, mask) in enumerate(zip(visible.items, hidden, strict=True)):
        for j, channel in enumerate(run.model.channels):
            values = item.values[np.isfinite(item.values[:, j]), j]
            if channel.state is not None and mask[:1].any() and len(values):
                out[i, channel.state] = np.median(values)
    return out


def _places(instance: GeneratedModule, trajectories: Trajectories, going_on: bool) -> list[int | None]:
    """Which trajectory of the training each one is or, with `going_on`, begins with; None for new ones."""
    found = instance.info.get("fingerprints")
    learned = {str(mark): i for i, mark in enumerate(found if isinstance(found, list) else [])}
    longer = continued(instance.info.get("beginnings") if going_on else None, trajectories.items)
    pairs = zip(trajectories.items, longer, strict=True)
    return [learned.get(fingerprint(item), None if found is None else found[0]) for item, found in pairs]


def _known(
    run: Run, instance: GeneratedModule, trajectories: Trajectories, guess: Array, going_on: bool
) -> tuple[Array, Array]:
    """Starts [N, n] and learnable constants [N, k] of trajectories: those learned, where training saw them."""
    model, known, weights = run.model, len(run.model.constants), instance.weights
    starts = guess.copy()
    constants = np.tile(np.asarray(weights["constants"], dtype=np.float64)[known:], (len(trajectories), 1))
    kinds = np.array([state.initial.kind == "learned" for state in model.states])
    for i, place in enumerate(_places(instance, trajectories, going_on)):
        if place is None:
            continue
        starts[i, kinds] = np.asarray(weights["initial"])[place, kinds]
        for j, learnable in enumerate(model.learnables):
            if learnable.per_trajectory and f"per_trajectory.{learnable.name}" in weights:
                constants[i, j] = weights[f"per_trajectory.{learnable.name}"][place]
    return starts, constants
