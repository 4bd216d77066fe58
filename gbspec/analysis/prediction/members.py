"""What one member predicts of trajectories, with the variance from its uncertainty and from that of their starts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.displaced import Displaced, Refit, unchanged, variance_of
from gbspec.analysis.prediction.estimate import Estimator, estimator_of
from gbspec.analysis.prediction.moving_jumps import moving_intervals
from gbspec.analysis.prediction.nearby import Nearby, step_to_compare, variables_of
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
from gbspec.ir import may_jump, slopes

if TYPE_CHECKING:
    from gbspec.analysis.systems import Individuals
    from gbspec.backends import Evaluator
    from gbspec.data import Scales, Trajectories, Trajectory
    from gbspec.runs import Run


@dataclass(frozen=True)
class View:
    """One member's prediction of one trajectory: mean [R, V], and variance [R, V] from the uncertainty of its start and
    of the learned model; `low` and `high` [R, V]: the lowest and highest solutions where a row may be on the other side
    of an event, else the mean."""

    prediction: Prediction
    variables: Array
    variance: Array
    low: Array
    high: Array


class MemberPredictions:
    """The predictions of one member for a table."""

    def __init__(
        self,
        evaluator: Evaluator,
        run: Run,
        trajectories: Trajectories,
        scales: Scales,
        number: int,
        released: bool,
    ) -> None:
        self.evaluator, self.run, self.model, self.trajectories = evaluator, run, run.model, trajectories
        self.estimator = estimator_of(evaluator, run.model, run.fit, scales, released)
        self.scales, self.number = scales, number
        self.covariance = run.certainties(number).covariance
        learned = learned_positions(evaluator.instance, trajectories, run.fit.data)
        self.longer = continued_positions(evaluator.instance, trajectories, run.fit.data)
        pairs = zip(learned, self.longer, strict=True)
        self.positions = [position if begun is None else None for position, begun in pairs]
        self.displaced = Displaced(
            evaluator.instance,
            self.covariance,
            given=frozenset(run.values),
            jumping=may_jump(run.model),
            moving=moving_intervals(run),
        )

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
        found = predict(self.evaluator, self.model, item, start)
        variables = variables_of(self.model, found)
        variance = np.zeros_like(variables)
        low, high = variables, variables
        refitted: Refit = unchanged
        if not found.failure:
            near = Nearby(self.evaluator, self.model, item, found, step_to_compare(self.run, self.number, item))
            individuals = self._individuals(start, item)
            if start.origin in ("estimated", "average", "continued", "learned"):
                variance, refitted = self._uncertainty(near, seen, estimator, individuals)
            for state, deviation in measured_deviations(self.run, item, estimator.free(seen)).items():
                change = deviation * near.slope(deviation, state=state)
                variance = variance + refitted(change) ** 2

            def solve(evaluator: Evaluator, moved: Start) -> Array:
                own, change = moved.constants, moved.constants - start.constants
                if individuals is not None:
                    own = individuals.moved(start.constants, change)
                # Initial values that are expressions, or steady states, follow from the displaced constants.
                return near.solve(started(evaluator, item, moved.state, own, moved.origin), evaluator)

            slopes = self.displaced.slopes(start, variables, solve, refitted)
            low, high = self.displaced.passed(start, variables, slopes, solve, refitted)
            variance = variance + variance_of(variables, slopes)
        return View(found, variables, variance, low, high)

    def _individuals(self, start: Start, item: Trajectory) -> Individuals | None:
        """The distribution of what a trajectory has of its own, before its rows are seen. What was learned of the
        groups of a trajectory of the training contains these."""
        new = start.origin in ("estimated", "average")
        return self.estimator.of_groups(item) if new else self.estimator.individuals

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

    def _uncertainty(
        self, near: Nearby, seen: Trajectory, estimator: Estimator, individuals: Individuals | None
    ) -> tuple[Array, Refit]:
        """The variance [R, V] from the covariance of the estimate, the diagonal of J (J'WJ + P)^-1 J', by differences;
        and how a change d of the solution that the shared parameters make is met by the estimate, which is refitted to
        the window: d - J (J'WJ + P)^-1 J'W d.

        W is the precision of the window's residuals (from the fit's noise, or their size if that is larger), P that of
        the prior.
        """
        from scipy.linalg import block_diag

        from gbspec.data import present_item  # with sympy, which not every command needs

        free, variables = [*estimator.free(seen)], near.variables
        seen = present_item(self.model, seen)
        own = list(estimator.own if individuals is None else individuals.place)
        if not free and not own:
            return np.zeros_like(variables), unchanged
        root = np.diag(estimator.own_sd) if individuals is None else individuals.root(near.found.start.constants)
        own_sd = np.sqrt(np.sum(root**2, axis=1))
        scale = np.concatenate([estimator.start_sd(seen)[free], np.where(own_sd > 0, own_sd, estimator.own_sd)])
        rows, channels = len(seen.times), seen.values.shape[1]
        predicted, scales = variables[:rows, :channels], estimator.scales
        factor = scales.factor(seen)
        measured = factor > 0
        misfit = estimator.residuals(seen, predicted)[measured]
        typical = float(np.sqrt(np.mean(misfit**2))) if measured.any() else 0.0
        in_residuals = slopes(predicted, seen.values, factor, scales.log)
        places: list[tuple[int | None, int | None]] = [*((i, None) for i in free), *((None, i) for i in own)]
        slopes_by = [
            near.suited_slope(size, place, in_residuals, typical) for size, place in zip(scale, places, strict=True)
        ]
        moves = np.stack(slopes_by, axis=-1) @ block_diag(np.diag(scale[: len(free)]), root)
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
