"""Initial states and per-trajectory constants of new trajectories: least squares with the learned parameters fixed.

The unknowns are the initial values that are neither given by the model nor measured in the first row, and the
learnables that each trajectory has for itself. The residuals are those of `gbspec.ir.residual` with the scales and
weights of `gbspec.data.scales_of`, as in training. A prior from the training trajectories adds a penalty on the
distance from its center: weighted according to the noise if that is known, else just strong enough to bound what the
data do not determine.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.solutions import (
    Prediction,
    Start,
    learned_positions,
    learned_start,
    measured_start,
    needed,
    predict,
)
from gbspec.analysis.systems import quasirandom_points
from gbspec.arrays import Array
from gbspec.data import recognised, scales_of
from gbspec.ir import residuals

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
TRIALS = 8
"""Initial guesses that are compared before the best one is refined."""


@dataclass(frozen=True)
class Prior:
    """The prior of initial states: center and standard deviation [n] of the states."""

    center: Array
    sd: Array


def prior_of(member: GeneratedModule, model: Model) -> Prior:
    """The prior from the learned initial states of the training data, else from declared guesses and ranges."""
    learned = member.weights.get("initial")
    if learned is not None and len(learned):
        sd = learned.std(axis=0)
        return Prior(learned.mean(axis=0), np.where(sd > 0, sd, np.maximum(np.abs(learned).max(axis=0), 1.0)))
    center, sd = [], []
    for state in model.states:
        box = state.range if state.range is not None and state.range.bounded else None
        guess = state.start if state.start is not None else ((box.low + box.high) / 2 if box else 0.0)
        center.append(guess)
        sd.append((box.high - box.low) / 4 if box and box.high > box.low else max(1.0, abs(guess)))
    return Prior(np.array(center, dtype=float), np.array(sd, dtype=float))


def predictions(
    evaluator: Evaluator, model: Model, trajectories: Trajectories, fit: FitRecord | None = None
) -> list[Prediction]:
    """The predictions of one member for a table, from learned initial states if possible, else known or estimated ones.

    `fit` is the content of the run's `fit.json`, if there is a run.
    """
    scales = scales_of(model, trajectories) if fit is None else fit.scales_for(model, trajectories)
    estimator = Estimator(evaluator, model, scales)
    positions = learned_positions(evaluator.instance, trajectories, None if fit is None else fit.data)
    starts = [
        estimator.start(item) if position is None else learned_start(evaluator, position, item)
        for item, position in zip(trajectories.items, positions, strict=True)
    ]
    return [predict(evaluator, model, item, start) for item, start in zip(trajectories.items, starts, strict=True)]


class Estimator:
    """Least squares for the initial state of one trajectory. `scales` are those of the whole table that it is from;
    `noise` [C], if known, is the standard deviation of measurements of each channel (of logarithms, if log-normal).
    `released`: initial values that the first row measures are estimated too, and that row is data like all others."""

    def __init__(
        self, evaluator: Evaluator, model: Model, scales: Scales, noise: Array | None = None, released: bool = False
    ) -> None:
        self.evaluator, self.model, self.scales, self.released = evaluator, model, scales, released
        self.noise = np.zeros(len(model.channels)) if noise is None else noise / scales.channel
        self.pull = max(PULL, float(np.median(self.noise)))
        self.prior = prior_of(evaluator.instance, model)
        self.own = tuple(evaluator.instance.constants.index(name) for name in evaluator.instance.per_trajectory)
        self.own_sd = self._sd_of_own()
        bounds = {k.name: (k.range.low, k.range.high) for k in model.learnables}
        ends = [bounds.get(name, (-np.inf, np.inf)) for name in evaluator.instance.constants]
        self.low, self.high = np.array(ends, dtype=float).reshape(-1, 2).T

    def _sd_of_own(self) -> Array:
        """The standard deviation over the training trajectories of each per-trajectory constant."""
        center = np.abs(np.asarray(self.evaluator.constants, dtype=float)[list(self.own)])
        found = [
            self.evaluator.instance.weights.get(f"per_trajectory.{n}") for n in self.evaluator.instance.per_trajectory
        ]
        sd = [0.0 if values is None or len(values) < 2 else float(np.std(values, ddof=1)) for values in found]
        return np.where(np.array(sd) > 0, sd, np.maximum(center, 1e-3))

    def residuals(self, item: Trajectory, channels: Array) -> Array:
        """The residuals [R, C] of predicted channels [R, C]; 0 where nothing was measured."""
        found = residuals(channels, item.values, self.scales.factor(item), self.scales.log)
        return np.asarray(found, dtype=np.float64)

    def free(self, item: Trajectory) -> tuple[int, ...]:
        """The states whose initial values are estimated."""
        if not self.released:
            return needed(self.model, item)
        return tuple(i for i, state in enumerate(self.model.states) if state.initial.kind != "expression")

    def start(self, item: Trajectory) -> Start:
        """The start of a trajectory: known, or estimated from its data; `failed` if none can be integrated."""
        free = self.free(item)
        state = measured_start(self.model, item, self._nearest(item))
        constants = np.array(self.evaluator.constants, dtype=float)
        if not free and not self.own:
            return Start(self.evaluator.initial(state, item.condition, constants), constants, "known")
        return self._estimate(item, state, constants, free)

    def start_sd(self, item: Trajectory) -> Array:
        """The prior standard deviation [n] of each initial value; smaller if a recognition network gives it."""
        found = recognised(self.evaluator.instance.weights, self.model, item)
        return self.prior.sd if found is None else np.minimum(self.prior.sd, found[1])

    def _nearest(self, item: Trajectory) -> Array:
        """The prior's center or the recognition network's output, with early measurements of states inserted."""
        found = recognised(self.evaluator.instance.weights, self.model, item)
        state = (self.prior.center if found is None else found[0]).copy()
        early = max(3, len(item.times) // 10)
        for j, channel in enumerate(self.model.channels):
            rows = np.flatnonzero(np.isfinite(item.values[:early, j]))
            if channel.state is not None and len(rows):
                state[channel.state] = item.values[rows[0], j]
        return state

    def _estimate(self, item: Trajectory, state: Array, constants: Array, free: tuple[int, ...]) -> Start:
        from scipy.optimize import least_squares

        columns = list(free)
        scale = np.concatenate([self.start_sd(item)[columns], self.own_sd])
        factor = self.scales.factor(item)
        measured = factor > 0
        worst = UNSOLVED * np.concatenate([(factor * self.scales.deviation)[measured], np.ones(len(scale))])

        def moved(z: Array) -> Start:
            x0, k = state.copy(), constants.copy()
            x0[columns] += scale[: len(columns)] * z[: len(columns)]
            k[list(self.own)] += scale[len(columns) :] * z[len(columns) :]
            k = np.clip(k, self.low, self.high)
            return Start(self.evaluator.initial(x0, item.condition, k), k, "estimated")

        def errors(z: Array) -> Array:
            found: Prediction = predict(self.evaluator, self.model, item, moved(z), TOLERANCE)
            if found.failure:
                return worst
            return np.concatenate([self.residuals(item, found.channels)[measured], self.pull * z])

        trials = self._trials(len(scale))
        with np.errstate(over="ignore"):  # squares of a diverging solution: its cost is infinite
            costs = [float(np.sum(errors(z) ** 2)) for z in trials]
            best = trials[int(np.argmin(costs))]
            if min(costs) >= float(np.sum(worst**2)):
                return Start(state, constants, "failed", "no initial state was found from which it can be integrated")
            solution = least_squares(errors, best, diff_step=1e-3, xtol=1e-6, ftol=1e-8, gtol=1e-10, max_nfev=20)
        return moved(np.asarray(solution.x, dtype=float))

    @staticmethod
    def _trials(size: int) -> list[Array]:
        """The guess and points around it, in units of the standard deviation."""
        around = 3.0 * quasirandom_points(TRIALS, size) - 1.5
        return [np.zeros(size), *around]
