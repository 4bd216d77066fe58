"""The filter of a finished run on a table: states as measurements show them, and predictions ahead of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

from gbspec.arrays import Array, Mask, as_measured
from gbspec.backends import GeneratedModule
from gbspec.data import Trajectories, continued, fingerprint
from gbspec.training.engines import Filtered, FilterEngine, Whiteness, filter, whiteness
from gbspec.training.options import TrainOptions
from gbspec.training.problem import Integers
from gbspec.training.recipe import build_context
from gbspec.training.runs.own_constants import Own, estimated_own

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
    """A member's filter on a table, with the measurements that it used. `own`: what of new trajectories was estimated
    from these, in the vector."""

    engine: FilterEngine
    vector: Array
    found: Filtered
    own: Own | None = None

    @property
    def estimated(self) -> tuple[str, ...]:
        """The constants of single trajectories that were estimated here; none where the training has learned them."""
        learnables = () if self.own is None else self.engine.parameters.model.learnables
        return tuple(k.name for k in learnables if k.per_trajectory)

    @property
    def constants(self) -> Array:
        """All constants of each trajectory [N, K]."""
        theta = torch.from_numpy(self.engine.layout.split(self.vector)[0].copy())
        return np.asarray(self.engine.parameters.constants(theta).numpy(), dtype=np.float64)

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

    def smoothed(self, draws: int = 0) -> list[RowMoments]:
        """States and channels at the rows of each trajectory as all used measurements show them. The standard
        deviations contain the uncertainty of the fitted parameters as `draws` of them show it."""
        return self._moments(self._path, self._of_draws(self._path, draws))

    def smoothed_after(self, training: Covariance | FilteredRun | None) -> list[RowMoments]:
        """The same with the uncertainty that the fit to other data has left of what all trajectories share: its
        covariance, or the filter of these data (None: it is not known); and with that of constants of new ones."""
        return self._moments(self._path, self._of_training(self._path, training))

    def one_ahead(self, draws: int = 0) -> list[RowMoments]:
        """The same as `smoothed` as the measurements before each row show them; NaN in the first rows."""
        return self._moments(self._before, self._of_draws(self._before, draws))

    def one_ahead_after(self, training: Covariance | FilteredRun | None) -> list[RowMoments]:
        """The same with the uncertainty that the fit to other data has left."""
        return self._moments(self._before, self._of_training(self._before, training))

    def states_ahead(self) -> list[Array]:
        """The states [R, n] at the rows of each trajectory as the measurements before each row show them, in steps as
        they were taken; NaN in first rows."""
        before = self.engine.row_states(self.found)[0]
        return [np.where(np.arange(len(mine))[:, None] > 0, before[mine], np.nan) for mine in self._rows]

    def _of_draws(self, path: _Path, draws: int) -> _Variances | None:
        """The variances of coordinates [R, n] and channels [R, C] over parameters that the data may have come from."""
        if not draws or not self.finite:
            return None
        engine, seen = self.engine, self.found.seen
        found = [(each, engine.filtered(each, seen)) for each in engine.draws(self.vector, self.found, draws)]
        paths = [path(each, one)[0::2] for each, one in found if one.finite]
        if len(paths) < 2:
            return None
        z, y = (np.var(np.array(tables), axis=0, ddof=1) for tables in zip(*paths, strict=True))
        return z, y

    def _of_training(self, path: _Path, training: Covariance | FilteredRun | None) -> _Variances | None:
        """The same by differences along the columns of a square root of a covariance of shared constants, or along
        draws of all shared parameters; with the uncertainty of constants of new trajectories."""
        if not self.finite:
            return None
        changes = self._drawn(training) if isinstance(training, FilteredRun) else self._displaced(training)
        found = [
            self._difference(path, change if self.own is None else self.own.followed(change)) for change in changes
        ]
        squares = [one for one in found if one is not None]
        means = [np.mean(np.array(tables), axis=0) for tables in zip(*squares, strict=True)]
        columns = [] if self.own is None else self.own.columns(len(self.vector))
        each = [*([means] if means else []), *(self._difference(path, column) for column in columns)]
        some = [one for one in each if one is not None]
        if not some:
            return None
        z, y = (np.sum(np.array(tables), axis=0) for tables in zip(*some, strict=True))
        return z, y

    def _displaced(self, training: Covariance | None) -> list[Array]:
        """Changes of the vector whose mean outer product is a covariance of shared constants; none without one."""
        if training is None:
            return []
        parameters, out = self.engine.parameters, list[Array]()
        places = slice(parameters.n_weights, parameters.n_shared)
        slopes = parameters.bijections(parameters.shared).derivative(self.vector[places])
        names = [parameters.model.learnables[i].name for i in parameters.shared]
        for _, constants in training.displacements(np.random.default_rng(67), PAIRS):
            by = dict(zip(training.constants, constants, strict=True))
            change = np.zeros(len(self.vector))
            shifts = np.array([by.get(name, 0.0) for name in names])
            change[places] = np.divide(shifts, slopes, out=np.zeros_like(shifts), where=slopes > 0)  # 0: at a bound
            out.append(change)
        return out

    def _drawn(self, training: FilteredRun) -> list[Array]:
        """Changes of the vector that draws of what all trajectories share make, of the data of the fit."""
        if not training.finite:
            return []
        shared = self.engine.parameters.n_shared
        vectors = training.engine.draws(training.vector, training.found, PAIRS)
        return [np.append(one[:shared], np.zeros(len(self.vector) - shared)) for one in vectors - training.vector]

    def _difference(self, path: _Path, change: Array) -> list[Array] | None:
        """The squares of what a change of the vector does to coordinates and channels; None where it cannot be seen."""
        ends = [self.vector + SHORTENED * change, self.vector - SHORTENED * change]
        found = [self.engine.filtered(end, self.found.seen) for end in ends]
        if not all(one.finite for one in found):
            return None
        up, down = (path(end, one)[0::2] for end, one in zip(ends, found, strict=True))
        return [((a - b) / (2 * SHORTENED)) ** 2 for a, b in zip(up, down, strict=True)]

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
    own_of: FilteredRun | None = None,
) -> FilteredRun:
    """A member's filter on a table; with `window` only the first so many measured rows of each trajectory are used (a
    number for all or for each of them), and none that are `hidden` (for each trajectory a mask of its rows).
    `max_step`: its largest step, else the fit's. What new trajectories have of their own is estimated from the used
    rows, or is that `own_of` another filter of the same table."""
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
    if own_of is not None:
        return FilteredRun(engine, own_of.vector, engine.filtered(own_of.vector, seen=seen), own_of.own)
    new = [i for i, place in enumerate(_places(instance, trajectories, window is None)) if place is None]
    vector, own = estimated_own(engine, vector, seen, new, instance.weights)
    return FilteredRun(engine, vector, engine.filtered(vector, seen=seen), own)


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
