"""Initial states (and own constants) of trajectories that training did not see: least squares, shared weights frozen.

Estimated are the starts that neither the model expresses nor the first row measures, and the learnables of which each
trajectory has its own. The residuals are those of `gbspec.ir.residual` at all measured values, in units of the
standard deviation of the channel's data; what is known beforehand, from the trajectories of the training, pulls towards
its centre: as strongly as the noise says where that is known, else just enough to keep what the data do not determine
from running away.
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
from gbspec.analysis.systems import spread_points
from gbspec.arrays import Array
from gbspec.data import deviations, recognised
from gbspec.ir import logarithmic, residuals

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.data import Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import DataRecord


PULL = 1e-3
"""Least weight of the pull towards what was known beforehand, in units of its standard deviation."""
TOLERANCE = 1e-6
"""Relative tolerance of the solutions while a start is sought."""
TRIALS = 8
"""Starts that are tried before the best one is polished."""


@dataclass(frozen=True)
class Prior:
    """What is known of starts before a trajectory is looked at: centre and standard deviation [n] of the states."""

    centre: Array
    sd: Array


def prior_of(member: GeneratedModule, model: Model) -> Prior:
    """From the learned starts of the training data; where there are none, from declared guesses and ranges."""
    learned = member.weights.get("initial")
    if learned is not None and len(learned):
        sd = learned.std(axis=0)
        return Prior(learned.mean(axis=0), np.where(sd > 0, sd, np.maximum(np.abs(learned).max(axis=0), 1.0)))
    centre, sd = [], []
    for state in model.states:
        box = state.range if state.range is not None and state.range.bounded else None
        guess = state.start if state.start is not None else ((box.low + box.high) / 2 if box else 0.0)
        centre.append(guess)
        sd.append((box.high - box.low) / 4 if box and box.high > box.low else max(1.0, abs(guess)))
    return Prior(np.array(centre, dtype=float), np.array(sd, dtype=float))


def predictions(
    evaluator: Evaluator, model: Model, trajectories: Trajectories, data: DataRecord | None = None
) -> list[Prediction]:
    """The predictions of one member for a table: from learned starts on training data, else known or estimated ones.

    `data` is what `fit.json` says of the training data, where there is one.
    """
    estimator = Estimator(evaluator, model, deviations(model, trajectories))
    positions = learned_positions(evaluator.instance, trajectories, data)
    starts = [
        estimator.start(item) if position is None else learned_start(evaluator, position, item)
        for item, position in zip(trajectories.items, positions, strict=True)
    ]
    return [predict(evaluator, model, item, start) for item, start in zip(trajectories.items, starts, strict=True)]


class Estimator:
    """Least squares for the start of one trajectory. `scales` [C] are the residuals' (see `deviations`); `noise` [C],
    where it is known, is the standard deviation of measurements in the same units (of logarithms, if log-normal)."""

    def __init__(self, evaluator: Evaluator, model: Model, scales: Array, noise: Array | None = None) -> None:
        self.evaluator, self.model, self.scales = evaluator, model, scales
        self.logarithmic = logarithmic(model)
        self.pull = PULL if noise is None else max(PULL, float(np.median(noise / scales)))
        self.prior = prior_of(evaluator.instance, model)
        self.own = tuple(evaluator.instance.constants.index(name) for name in evaluator.instance.per_trajectory)
        self.own_sd = self._sd_of_own()
        bounds = {k.name: (k.range.low, k.range.high) for k in model.learnables}
        ends = [bounds.get(name, (-np.inf, np.inf)) for name in evaluator.instance.constants]
        self.low, self.high = np.array(ends, dtype=float).reshape(-1, 2).T

    def _sd_of_own(self) -> Array:
        """The standard deviation, over the training's trajectories, of each constant that these have for themselves."""
        centre = np.abs(np.asarray(self.evaluator.constants, dtype=float)[list(self.own)])
        found = [
            self.evaluator.instance.weights.get(f"per_trajectory.{n}") for n in self.evaluator.instance.per_trajectory
        ]
        sd = [0.0 if values is None or len(values) < 2 else float(np.std(values, ddof=1)) for values in found]
        return np.where(np.array(sd) > 0, sd, np.maximum(centre, 1e-3))

    def start(self, item: Trajectory) -> Start:
        """The start of a trajectory: known, or estimated from its data; `failed` where no start can be integrated."""
        free = needed(self.model, item)
        state = measured_start(self.model, item, self._nearest(item))
        constants = np.array(self.evaluator.constants, dtype=float)
        if not free and not self.own:
            return Start(self.evaluator.initial(state, item.condition, constants), constants, "known")
        return self._estimate(item, state, constants, free)

    def start_sd(self, item: Trajectory) -> Array:
        """How uncertain each state's start [n] is before the trajectory is fitted: less where it was recognised."""
        found = recognised(self.evaluator.instance.weights, self.model, item)
        return self.prior.sd if found is None else np.minimum(self.prior.sd, found[1])

    def _nearest(self, item: Trajectory) -> Array:
        """The prior's centre, or what a recognition network says; with early measurements of states put in."""
        found = recognised(self.evaluator.instance.weights, self.model, item)
        state = (self.prior.centre if found is None else found[0]).copy()
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
        measured = np.isfinite(item.values)
        worst = np.full(int(np.sum(measured)) + len(scale), 1e3)

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
            error = residuals(found.channels, item.values, 1.0 / self.scales, self.logarithmic)
            return np.concatenate([error[measured], self.pull * z])

        trials = self._trials(len(scale))
        with np.errstate(over="ignore"):  # squares of a solution that runs away: its cost is infinite
            costs = [float(np.sum(errors(z) ** 2)) for z in trials]
            best = trials[int(np.argmin(costs))]
            if min(costs) >= float(np.sum(worst**2)):
                return Start(state, constants, "failed", "no start was found from which it can be integrated")
            solution = least_squares(errors, best, diff_step=1e-3, xtol=1e-6, ftol=1e-8, gtol=1e-10, max_nfev=20)
        return moved(np.asarray(solution.x, dtype=float))

    @staticmethod
    def _trials(size: int) -> list[Array]:
        """The guess itself and points around it, in units of the standard deviation."""
        around = 3.0 * spread_points(TRIALS, size) - 1.5
        return [np.zeros(size), *around]
