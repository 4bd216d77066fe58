"""Initial states and per-trajectory constants of new trajectories: least squares with the learned parameters fixed.

The unknowns are the initial values that are neither given by the model nor measured in the first row, and the
learnables that each trajectory has for itself. The residuals are those of `gbspec.ir.residual` with the scales and
weights of `gbspec.data.scales_of`, as in training. A prior from the training trajectories adds a penalty on the
distance from its center: weighted according to the noise if that is known, else just strong enough to bound what the
data do not determine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gbspec.analysis.prediction.differences import LONGEST, TOO_LONG, suited
from gbspec.analysis.prediction.noise import at_least_one, depends_on_value, residual_noise
from gbspec.analysis.prediction.solutions import (
    Prediction,
    Start,
    continued_positions,
    learned_positions,
    learned_start,
    measured_start,
    needed,
    predict,
    started,
)
from gbspec.analysis.systems import Individuals, quasirandom_points
from gbspec.arrays import Array
from gbspec.data import absent_states, present_item, recognised, scales_of, sobol, spread_over_ranges
from gbspec.ir import residuals
from gbspec.runs import spread_of_next

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.data import Scales, Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import FitRecord


PULL = 1e-3
"""Least weight of the penalty towards the prior's center, with distances in units of its standard deviation."""
TOLERANCE = 1e-6
"""Relative tolerance of the solutions during the estimation."""
UNSOLVED = 1e3
"""The residuals of a solution that cannot be integrated, in standard deviations of the data."""
COARSE = 1e-4
"""The same of those that are only compared, where that saves steps and needs no other integrator (with delays)."""
TRIALS, AROUND = 8, 1.5
"""Initial guesses so many standard deviations around the prior's center, which are compared before the best ones are
refined,"""
LEARNED = 8
"""with at most so many of the starts that the training has learned."""
SEVERAL = 3
"""So many of the best guesses are improved before the best one is refined."""
INSIDE = 1e-9
"""Distance of a guess from a bound, in standard deviations."""
WIDE = 32
"""Further guesses over the whole ranges of constants that each trajectory has for itself."""
SCREENED, SCREEN = 12, 4
"""Then, `SCREENED` guesses are improved with at most `SCREEN` evaluations beside their derivatives,"""
REFINED, AGREED, SAME = 6, 2, 1e-3
"""and up to `REFINED` of these further, until `AGREED` have led to the best cost, up to the fraction `SAME`."""


LEAST_NOISE = 1e-3
"""No value counts with less noise than this part of the median one."""
AGAIN = 3
"""How often a trajectory is estimated where its noise depends on its prediction: with the noise at the data first, then
at the solution before."""
Varying = Callable[[Array], Array]
"""The standard deviations of residuals [R, C], in the channels' units or of logarithms, at predicted channels."""


@dataclass(frozen=True)
class Prior:
    """The prior of initial states: center and standard deviation [n] of the states."""

    center: Array
    sd: Array


def prior_of(member: GeneratedModule, model: Model, scales: Scales) -> Prior:
    """The prior from the learned initial states of the training data, else from declared guesses and ranges."""
    learned = member.weights.get("initial")
    if learned is not None and len(learned):
        spread = spread_of_next(learned)
        wide = np.maximum(np.abs(learned).max(axis=0), _widths(model, scales))
        return Prior(learned.mean(axis=0), np.where(spread > 0, spread, wide))
    center, sd = [], []
    for state in model.states:
        box = state.range if state.range is not None and state.range.bounded else None
        guess = state.start if state.start is not None else ((box.low + box.high) / 2 if box else 0.0)
        center.append(guess)
        sd.append((box.high - box.low) / 4 if box and box.high > box.low else max(1.0, abs(guess)))
    return Prior(np.array(center, dtype=float), np.array(sd, dtype=float))


def _widths(model: Model, scales: Scales) -> Array:
    """The standard deviations [n] of states of which one start is known: that says nothing of how far others are from
    it. The declared range and the deviation of the data say how large the state can be; at least 1."""
    found = np.ones(len(model.states))
    for i, state in enumerate(model.states):
        if state.range is not None and state.range.bounded:
            found[i] = max(found[i], (state.range.high - state.range.low) / 4)
    for j, channel in enumerate(model.channels):
        if channel.state is not None and not scales.log[j] and np.isfinite(scales.deviation[j]):
            found[channel.state] = max(found[channel.state], float(scales.deviation[j]))
    return found


def predictions(
    evaluator: Evaluator, model: Model, trajectories: Trajectories, fit: FitRecord | None = None
) -> list[Prediction]:
    """The predictions of one member for a table, from learned initial states if possible (of the trajectory, or of one
    whose rows it begins with), else known or estimated ones.

    `fit` is the content of the run's `fit.json`, if there is a run.
    """
    scales = scales_of(model, trajectories) if fit is None else fit.scales_for(model, trajectories)
    estimator = refitting(evaluator, model, fit, scales)
    data = None if fit is None else fit.data
    positions = learned_positions(evaluator.instance, trajectories, data)
    longer = continued_positions(evaluator.instance, trajectories, data)
    starts = []
    for item, position, begun in zip(trajectories.items, positions, longer, strict=True):
        if position is not None:
            starts.append(learned_start(evaluator, position, item))
        elif begun is not None:  # the training has learned the start of a trajectory that begins with these rows
            starts.append(learned_start(evaluator, begun[0], item, "continued"))
        else:
            starts.append(estimator.start(item))
    return [predict(evaluator, model, item, start) for item, start in zip(trajectories.items, starts, strict=True)]


def refitting(evaluator: Evaluator, model: Model, fit: FitRecord | None, scales: Scales) -> Estimator:
    """The estimator of what trajectories are solved with. Where what they have of their own has a distribution, that is
    weighed against the noise of the fit."""
    if fit is None or not model.marginal:
        return Estimator(evaluator, model, scales)
    return estimator_of(evaluator, model, fit, scales)


def estimator_of(
    evaluator: Evaluator, model: Model, fit: FitRecord, scales: Scales, released: bool = False
) -> Estimator:
    """The estimator with the noise that a fit has found."""
    noise = residual_noise(model, fit, np.ones(len(model.channels)))
    if not depends_on_value(model, fit):
        return Estimator(evaluator, model, scales, noise, released)
    noise = np.array([fit.noise.get(channel.name) or 0.0 for channel in model.channels])

    def varying(values: Array) -> Array:
        return residual_noise(model, fit, at_least_one(model, values))

    return Estimator(evaluator, model, scales, noise, released, varying)


class Estimator:
    """Least squares for the initial state of one trajectory. `scales` are those of the whole table that it is from;
    `noise` [C], if known, is the standard deviation of measurements of each channel (of logarithms, if log-normal).
    `varying` gives it at predicted channels [R, C] where it depends on them.
    `released`: initial values that the first row measures are estimated too, and that row is data like all others."""

    def __init__(
        self,
        evaluator: Evaluator,
        model: Model,
        scales: Scales,
        noise: Array | None = None,
        released: bool = False,
        varying: Varying | None = None,
    ) -> None:
        self.varying = varying
        self.evaluator, self.model, self.scales, self.released = evaluator, model, scales, released
        self.noise = np.zeros(len(model.channels)) if noise is None else noise / scales.channel
        self.pull = max(PULL, float(np.median(self.noise)))
        self.prior = prior_of(evaluator.instance, model, scales)
        self.own = tuple(evaluator.instance.constants.index(name) for name in evaluator.instance.per_trajectory)
        self.own_sd = self._sd_of_own()
        self.individuals = Individuals.of_member(evaluator.instance, model)
        bounds = {k.name: (k.individual.range.low, k.individual.range.high) for k in model.learnables}
        ends = [bounds.get(name, (-np.inf, np.inf)) for name in evaluator.instance.constants]
        self.low, self.high = np.array(ends, dtype=float).reshape(-1, 2).T

    def _sd_of_own(self) -> Array:
        """The standard deviation over the training trajectories of each per-trajectory constant."""
        center = np.abs(np.asarray(self.evaluator.constants, dtype=float)[list(self.own)])
        found = [
            self.evaluator.instance.weights.get(f"per_trajectory.{n}") for n in self.evaluator.instance.per_trajectory
        ]
        # Where constants have a distribution, its spread was fitted, and what is estimated here are shrunken values.
        spread = spread_of_next if not self.model.marginal else lambda values: np.std(values, axis=0, ddof=1)
        sd = [0.0 if values is None or len(values) < 2 else float(spread(np.asarray(values))) for values in found]
        return np.where(np.array(sd) > 0, sd, np.maximum(center, 1e-3))

    def residuals(self, item: Trajectory, channels: Array) -> Array:
        """The residuals [R, C] of predicted channels [R, C]; 0 where nothing was measured."""
        found = residuals(channels, item.values, self.scales.factor(item), self.scales.log)
        return np.asarray(found, dtype=np.float64)

    def free(self, item: Trajectory) -> tuple[int, ...]:
        """The states whose initial values are estimated."""
        if not self.released:
            return needed(self.model, item)
        (absent,) = absent_states(self.model, [item])
        return tuple(i for i, state in enumerate(self.model.states) if not (state.initial.known or absent[i]))

    def start(self, item: Trajectory) -> Start:
        """The start of a trajectory: known, or estimated from its data; `failed` if none can be integrated."""
        free = self.free(item)
        state = measured_start(self.model, item, self._nearest(item))
        constants = np.array(self.evaluator.constants, dtype=float)
        if not free and not self.own:
            return started(self.evaluator, item, state, constants, "known")
        return self._estimate(present_item(self.model, item), state, constants, free)

    def start_sd(self, item: Trajectory) -> Array:
        """The prior standard deviation [n] of each initial value; smaller if a recognition network gives it. Where a
        measured value is its center, it has the noise of that one too."""
        found = recognised(self.evaluator.instance.weights, self.model, item)
        sd = (self.prior.sd if found is None else np.minimum(self.prior.sd, found[1])).copy()
        for state, (value, channel) in self._measured(item).items():
            noise = self.noise[channel] * self.scales.channel[channel]
            sd[state] = np.hypot(sd[state], noise * abs(value) if self.scales.log[channel] else noise)
        return sd

    def _nearest(self, item: Trajectory) -> Array:
        """The prior's center or the recognition network's output, with early measurements of states inserted."""
        found = recognised(self.evaluator.instance.weights, self.model, item)
        state = (self.prior.center if found is None else found[0]).copy()
        for place, (value, _) in self._measured(item).items():
            state[place] = value
        return state

    def _measured(self, item: Trajectory) -> dict[int, tuple[float, int]]:
        """The first of the early measurements of each state that has one, with its channel."""
        early, out = max(3, len(item.times) // 10), dict[int, tuple[float, int]]()
        for j, channel in enumerate(self.model.channels):
            rows = np.flatnonzero(np.isfinite(item.values[:early, j]))
            if channel.state is not None and len(rows):
                out[channel.state] = float(item.values[rows[0], j]), j
        return out

    def of_groups(self, item: Trajectory) -> Individuals | None:
        """The distribution of a new trajectory's own constants, with what was learned of its groups."""
        if self.individuals is None:
            return None
        names = (condition.name for condition in self.model.conditions)
        return self.individuals.of_groups(dict(zip(names, item.condition.tolist(), strict=True)))

    def _estimate(self, item: Trajectory, state: Array, constants: Array, free: tuple[int, ...]) -> Start:
        columns, individuals = list(free), self.of_groups(item)
        scale = np.concatenate([self.start_sd(item)[columns], self.own_sd])
        factor = self.scales.factor(item)
        measured = factor > 0
        worst = UNSOLVED * np.concatenate([(factor * self.scales.deviation)[measured], np.ones(len(scale))])

        def moved(z: Array) -> Start:
            x0, k = state.copy(), constants.copy()
            x0[columns] += scale[: len(columns)] * z[: len(columns)]
            if individuals is not None:  # z has the distribution that the fit has found
                k = individuals.constants(k, z[len(columns) :])
            else:
                k[list(self.own)] += scale[len(columns) :] * z[len(columns) :]
                k = np.clip(k, self.low, self.high)
            return started(self.evaluator, item, x0, k, "estimated" if measured.any() else "average")

        weights = self._weights(item.values)

        def errors(z: Array, rtol: float = TOLERANCE) -> Array:
            found: Prediction = predict(self.evaluator, self.model, item, moved(z), rtol)
            if found.failure:
                return worst
            return np.concatenate([(weights * self.residuals(item, found.channels))[measured], self.pull * z])

        with np.errstate(over="ignore"):  # squares of a diverging solution: its cost is infinite
            trials = self._trials(scale, constants, state, columns)
            rtol = COARSE if self.model.delays else TOLERANCE
            tried = [errors(z, rtol) for z in trials]
            costs = np.array([np.inf if one is worst else float(np.sum(one**2)) for one in tried])
            solved = [trials[i] for i in np.argsort(costs, kind="stable") if np.isfinite(costs[i])]
            if not solved:
                return Start(state, constants, "failed", "no initial state was found from which it can be integrated")
            # logarithms of predictions of zero or less are continued, and may be far from those of the data
            worst = worst * max(1.0, 10 * np.sqrt(costs[np.isfinite(costs)].max() / np.sum(worst**2)))
            # No other minimum is much better than one that follows the data as closely as their noise lets it.
            enough = int(measured.sum()) * self.pull**2 if self.noise.min() > 0 else 0.0
            found = self._refined(errors, solved, ends := self._ends(scale, constants), enough)
            for _ in range(AGAIN - 1 if self.varying is not None else 0):
                solution = predict(self.evaluator, self.model, item, moved(found), TOLERANCE)
                if solution.failure:
                    break
                weights = self._weights(solution.channels)
                found = _least(errors, found, ends, 20).vector
            return moved(found)

    def _weights(self, channels: Array) -> Array | float:
        """The weights [R, C] of residuals whose noise depends on the channels [R, C]; 1 without."""
        if self.varying is None:
            return 1.0
        return np.asarray(self.pull / self.deviation(channels), dtype=np.float64)

    def deviation(self, channels: Array) -> Array:
        """The standard deviations of residuals at predicted channels [R, C], in units of the channels' scales."""
        if self.varying is None:
            return np.broadcast_to(self.noise, channels.shape)
        found = self.varying(np.where(np.isfinite(channels), channels, 0.0)) / self.scales.channel
        return np.maximum(found, LEAST_NOISE * self.pull)

    def _refined(
        self, errors: Callable[[Array], Array], trials: list[Array], ends: tuple[Array, Array], enough: float
    ) -> Array:
        """The best of the refined guesses: of the first ones alone, if no constants have a range of their own, and of
        no more than leads to a sum of squares of `enough`."""
        if not self.own:
            near: list[Least] = []
            for trial in trials[:SEVERAL]:
                near.append(_least(errors, trial, ends, SCREEN))
                if 2 * near[-1].cost <= enough:
                    break
            best = min(near, key=lambda found: found.cost)
            return best.vector if best.converged else _least(errors, best.vector, ends, 20).vector
        # The guesses with the least cost are often merely those with the smallest effect: others are tried too.
        some = [*trials[: SCREENED // 2], *trials[SCREENED // 2 :: max(len(trials) * 2 // SCREENED - 1, 1)]][:SCREENED]
        screened = sorted((_least(errors, trial, ends, SCREEN) for trial in some), key=lambda found: found.cost)
        refined: list[Least] = []
        for one in screened[:REFINED]:
            refined.append(one if one.converged else _least(errors, one.vector, ends, 20))
            least = min(found.cost for found in refined)
            if sum(found.cost <= least * (1 + SAME) for found in refined) >= AGREED:
                break
        return min(refined, key=lambda found: found.cost).vector

    def _ends(self, scale: Array, constants: Array) -> tuple[Array, Array]:
        """The bounds of the unknowns, in standard deviations from the guess; those of constants alone are finite."""
        low, high = np.full(len(scale), -np.inf), np.full(len(scale), np.inf)
        if self.own and self.individuals is None:
            own, sd = list(self.own), self.own_sd
            low[-len(own) :] = (self.low[own] - constants[own]) / sd - INSIDE
            high[-len(own) :] = (self.high[own] - constants[own]) / sd + INSIDE
        return low, high

    def _trials(self, scale: Array, constants: Array, state: Array, free: list[int]) -> list[Array]:
        """The guess, points around it, in units of the standard deviation, starts that were learned in training, and
        constants over their whole ranges."""
        low, high = np.full(len(scale), -AROUND), np.full(len(scale), AROUND)
        for i, place in enumerate(free):
            box = self.model.states[place].range
            if box is not None and box.low < state[place] < box.high:  # no guess where the state cannot be
                low[i] = max(low[i], (box.low - state[place]) / scale[i])
                high[i] = min(high[i], (box.high - state[place]) / scale[i])
        around = low + (high - low) * quasirandom_points(TRIALS, len(scale))
        out = [np.zeros(len(scale)), *around, *self._learned(scale, constants, state, free)]
        if not self.own or self.individuals is not None:
            return out
        own, points = list(self.own), sobol(WIDE, len(scale), 0)
        learnables = {k.name: k for k in self.model.learnables}
        named = tuple(learnables[name] for name in self.evaluator.instance.per_trajectory)
        wide = low + (high - low) * points
        wide[:, -len(own) :] = (spread_over_ranges(named, points[:, -len(own) :]) - constants[own]) / self.own_sd
        return [*out, *wide]

    def _learned(self, scale: Array, constants: Array, state: Array, free: list[int]) -> list[Array]:
        """Starts of the training, with their own constants, as unknowns: near one of them a solution may follow the
        data that guesses around a measured value do not come close to."""
        weights = self.evaluator.instance.weights
        learned = weights.get("initial")
        if learned is None or not len(learned) or not free:
            return []
        chosen = np.unique(np.linspace(0, len(learned) - 1, min(LEARNED, len(learned))).round().astype(int))
        found = np.zeros((len(chosen), len(scale)))
        found[:, : len(free)] = (np.asarray(learned)[chosen][:, free] - state[free]) / scale[: len(free)]
        for i, place in enumerate(self.own if self.individuals is None else ()):
            values = weights.get(f"per_trajectory.{self.evaluator.instance.constants[place]}")
            if values is not None:
                found[:, len(free) + i] = (np.asarray(values)[chosen] - constants[place]) / self.own_sd[i]
        return [one for one in found if np.isfinite(one).all()]


class Least(NamedTuple):
    """Half the sum of squares and the vector that least squares have reached, and whether it is a minimum."""

    cost: float
    vector: Array
    converged: bool


def _least(errors: Callable[[Array], Array], guess: Array, ends: tuple[Array, Array], evaluations: int) -> Least:
    """What least squares reach within bounds."""
    from scipy.optimize import least_squares

    steps = np.full(len(guess), LONGEST)
    last: list[tuple[Array, Array]] = []

    def residual(z: Array) -> Array:
        last[:] = [(z.copy(), errors(z))]
        return last[0][1]

    def change(z: Array, f: Array, i: int, step: float) -> Array:
        moved = z.copy()
        moved[i] += step if z[i] + step < ends[1][i] else -step
        return np.asarray((errors(moved) - f) / (moved[i] - z[i]), dtype=np.float64)

    def slopes(z: Array) -> Array:
        f = last[0][1] if np.array_equal(last[0][0], z) else residual(z)
        columns = []
        for i in range(len(z)):
            column = change(z, f, i, steps[i])
            wanted = suited(steps[i], steps[i] * _rms(column), _rms(f))
            if steps[i] > TOO_LONG * wanted:
                column = change(z, f, i, wanted)
            steps[i] = wanted
            columns.append(column)
        return np.stack(columns, axis=1)

    inside = np.clip(guess, ends[0] + INSIDE, ends[1] - INSIDE)
    found = least_squares(residual, inside, slopes, bounds=ends, xtol=1e-6, ftol=1e-8, gtol=1e-10, max_nfev=evaluations)
    return Least(float(found.cost), np.asarray(found.x, dtype=float), bool(found.status > 0))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
