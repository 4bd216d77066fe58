"""What one member predicts of trajectories, with the variance from its uncertainty and from that of their starts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.differences import TOO_LONG, suited
from gbspec.analysis.prediction.displaced import Displaced, Refit, unchanged
from gbspec.analysis.prediction.estimate import Estimator, estimator_of
from gbspec.analysis.prediction.noise import measured_deviations
from gbspec.analysis.prediction.solutions import (
    Prediction,
    Start,
    continued_positions,
    learned_positions,
    learned_start,
    measured_start,
    predict,
    started,
)
from gbspec.arrays import Array
from gbspec.ir import slopes

if TYPE_CHECKING:
    from gbspec.backends import Evaluator
    from gbspec.data import Scales, Trajectories, Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Covariance, Run

NUDGE = 1e-3
"""The step of the finite differences that propagate the uncertainty of an initial value or constant, in units of its
standard deviation: the prior one, or that of the measurement."""
SHORTENED = 4
"""So many steps are tried where the solution bends within them."""


def hidden_states(model: Model) -> tuple[int, ...]:
    """The states whose names are not names of channels."""
    named = {channel.name for channel in model.channels}
    return tuple(i for i, state in enumerate(model.states) if state.name not in named)


@dataclass(frozen=True)
class View:
    """One member's prediction of one trajectory: mean [R, V], and variance [R, V] from the uncertainty of its start and
    of the learned model."""

    prediction: Prediction
    variables: Array
    variance: Array


class MemberPredictions:
    """The predictions of one member for a table."""

    def __init__(
        self,
        evaluator: Evaluator,
        run: Run,
        trajectories: Trajectories,
        scales: Scales,
        covariance: Covariance | None,
        released: bool,
    ) -> None:
        self.evaluator, self.run, self.model, self.trajectories = evaluator, run, run.model, trajectories
        self.estimator = estimator_of(evaluator, run.model, run.fit, scales, released)
        self.scales = scales
        self.positions = learned_positions(evaluator.instance, trajectories, run.fit.data)
        self.longer = continued_positions(evaluator.instance, trajectories, run.fit.data)
        self.displaced = Displaced(evaluator.instance, covariance, frozenset(run.values))

    @cached_property
    def freed(self) -> Estimator:
        """The estimator with measured initial values among what is free."""
        return estimator_of(self.evaluator, self.model, self.run.fit, self.scales, True)

    def view(self, index: int, rows: int, goes_on: bool) -> View:
        """The prediction of a trajectory from its first `rows` rows; `goes_on`: these are one of the training data, of
        which the start was learned."""
        item = self.trajectories.items[index]
        seen = item.at_rows(slice(rows))
        start, estimator = self._start(index, seen, goes_on)
        found, variables = self._solve(item, start)
        variance = np.zeros_like(variables)
        refitted: Refit = unchanged
        # Of channels in rows that were fitted the noise says nearly all; of unmeasured states it says nothing.
        enough = start.origin == "learned" and not hidden_states(self.model)
        if not found.failure and not enough:
            if start.origin in ("estimated", "continued", "learned"):
                variance, refitted = self._uncertainty(item, seen, start, variables, estimator)
            for state, deviation in measured_deviations(self.run, item, estimator.free(seen)).items():
                change = deviation * self._slope(item, start, deviation, state=state)
                variance = variance + refitted(change) ** 2

            def solve(evaluator: Evaluator, moved: Start) -> Array:
                # Initial values that are expressions, or steady states, follow from the displaced constants.
                begun = started(evaluator, item, moved.state, moved.constants, moved.origin)
                return self._solve(item, begun, evaluator)[1]

            variance = variance + self.displaced.variance(start, variables, solve, refitted)
            if start.origin == "learned":
                variance[:, : len(self.model.channels)] = 0.0
        return View(found, variables, variance)

    def _start(self, index: int, seen: Trajectory, goes_on: bool) -> tuple[Start, Estimator]:
        """The start of a trajectory of which rows are `seen`, and the estimator that has what is free in it."""
        item, position, longer = self.trajectories.items[index], self.positions[index], self.longer[index]
        if position is not None:
            start = learned_start(self.evaluator, position, item)
        elif goes_on and longer is not None:
            start = learned_start(self.evaluator, longer[0], item, "continued")
        else:
            return self.estimator.start(seen), self.estimator
        # The training has estimated measured initial values too, or has believed them.
        kept = [i for i, state in enumerate(self.model.states) if state.initial.kind == "measured"]
        believed = measured_start(self.model, seen, start.state)
        moved = not np.array_equal(believed[kept], start.state[kept])
        return start, self.freed if moved else self.estimator

    def _solve(self, item: Trajectory, start: Start, evaluator: Evaluator | None = None) -> tuple[Prediction, Array]:
        found = predict(self.evaluator if evaluator is None else evaluator, self.model, item, start)
        return found, np.concatenate([found.channels, found.states[:, list(hidden_states(self.model))]], axis=1)

    def _moved(
        self, item: Trajectory, start: Start, change: float, *, state: int | None = None, constant: int | None = None
    ) -> Array:
        """The solution [R, V] with an initial value or a constant changed."""
        moved, constants = start.state.copy(), start.constants.copy()
        if state is not None:
            moved[state] += change
        if constant is not None:
            constants[constant] += change
        return self._solve(item, started(self.evaluator, item, moved, constants, start.origin))[1]

    def _slope(self, item: Trajectory, start: Start, size: float, *, state: int) -> Array:
        """The derivative [R, V] of the solution by an initial value of this size, by differences."""
        nudge = NUDGE * size
        up, down = (self._moved(item, start, change, state=state) for change in (nudge, -nudge))
        return np.asarray((up - down) / (2 * nudge), dtype=np.float64)

    def _suited_slope(
        self,
        item: Trajectory,
        start: Start,
        size: float,
        place: tuple[int | None, int | None],
        variables: Array,
        in_residuals: Array,
        typical: float,
    ) -> Array:
        """The derivative [R, V] of the solution `variables` by an initial value or a constant (`place`) of this size,
        by differences of a step that suits the residuals of a window, whose root mean square is `typical` and which
        have the derivatives `in_residuals` [rows, C] by what is predicted."""
        (rows, channels), (state, constant), step = in_residuals.shape, place, NUDGE
        count = max(int(np.count_nonzero(in_residuals)), 1)
        for tried in range(SHORTENED):
            up = self._moved(item, start, step * size, state=state, constant=constant)
            changed = (up - variables)[:rows, :channels] * in_residuals
            wanted = suited(step, float(np.sqrt(np.sum(changed[in_residuals != 0] ** 2) / count)), typical)
            if step <= TOO_LONG * wanted or tried == SHORTENED - 1:
                break
            step = wanted
        down = self._moved(item, start, -step * size, state=state, constant=constant)
        return np.asarray((up - down) / (2 * step * size), dtype=np.float64)

    def _uncertainty(
        self, item: Trajectory, seen: Trajectory, start: Start, variables: Array, estimator: Estimator
    ) -> tuple[Array, Refit]:
        """The variance [R, V] from the covariance of the estimate, the diagonal of J (J'WJ + P)^-1 J', by differences;
        and how a change d of the solution that the shared parameters make is met by the estimate, which is refitted to
        the window: d - J (J'WJ + P)^-1 J'W d.

        W is the precision of the window's residuals (from the fit's noise, or their size if that is larger), P that of
        the prior.
        """
        free = [*estimator.free(seen)]
        own = list(estimator.own)
        if not free and not own:
            return np.zeros_like(variables), unchanged
        scale = np.concatenate([estimator.start_sd(seen)[free], estimator.own_sd])
        rows, channels = len(seen.times), seen.values.shape[1]
        predicted, scales = variables[:rows, :channels], estimator.scales
        factor = scales.factor(seen)
        measured = factor > 0
        misfit = estimator.residuals(seen, predicted)[measured]
        typical = float(np.sqrt(np.mean(misfit**2))) if measured.any() else 0.0
        in_residuals = slopes(predicted, seen.values, factor, scales.log)
        places: list[tuple[int | None, int | None]] = [*((i, None) for i in free), *((None, i) for i in own)]
        moves = np.stack(
            [
                size * self._suited_slope(item, start, size, place, variables, in_residuals, typical)
                for size, place in zip(scale, places, strict=True)
            ],
            axis=-1,
        )
        deviation = estimator.deviation(predicted)
        if estimator.varying is None:
            deviation = np.maximum(deviation, max(typical, 1e-9))
        of_residuals = in_residuals / deviation
        weighted = (moves[:rows, :channels] * of_residuals[:, :, None])[measured]
        inverse = np.linalg.inv(weighted.T @ weighted + np.eye(len(scale)))

        def refitted(change: Array) -> Array:
            in_window = (change[:rows, :channels] * of_residuals)[measured]
            return np.asarray(change - moves @ (inverse @ (weighted.T @ in_window)), dtype=np.float64)

        return np.asarray(np.einsum("rvi,ij,rvj->rv", moves, inverse, moves), dtype=np.float64), refitted
