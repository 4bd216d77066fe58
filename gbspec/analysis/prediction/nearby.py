"""Solutions near that of a trajectory, whose differences say what an initial value, a constant or a weight changes.

Where inputs change at many times, CVODES begins again at each of them, with short steps of low order, which costs more
than all else. Differences need no more than three digits: they are computed by the method of the training, in one step
from one of these times to the next or in steps as short as there, where the solution itself comes out the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.differences import TOO_LONG, suited
from gbspec.analysis.prediction.solutions import Prediction, Start, completed, predict, started
from gbspec.arrays import Array
from gbspec.ir import scheduled

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, StepPlan
    from gbspec.data import Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Run

NUDGE = 1e-3
"""The step of the finite differences that propagate the uncertainty of an initial value or constant, in units of its
standard deviation: the prior one, or that of the measurement."""
SHORTENED = 4
"""So many steps are tried where the solution bends within them."""

RESTARTS = 100
"""Fewer restarts than these are no reason for equal steps."""
STEPS_EACH = 10
"""The most steps for each restart: with more of them CVODES is as fast."""
SAME = 1e-4
"""The largest difference of the two solutions, relative to each state's range along them."""


def hidden_states(model: Model) -> tuple[int, ...]:
    """The states whose names are not names of channels."""
    named = {channel.name for channel in model.channels}
    return tuple(i for i, state in enumerate(model.states) if state.name not in named)


def variables_of(model: Model, found: Prediction) -> Array:
    """The channels and unmeasured states [R, V] of a solution."""
    return np.concatenate([found.channels, found.states[:, list(hidden_states(model))]], axis=1)


def restarts(item: Trajectory) -> int:
    """At how many times an input changes."""
    return len({float(time) for signal in item.inputs for time in signal.times})


def step_to_compare(run: Run, number: int, item: Trajectory) -> float | None:
    """The step of a member's training, if solutions of the trajectory may be compared by it: with equal steps, many
    restarts, and none at times that depend on what is displaced."""
    model, step = run.model, run.equal_step(number)
    moving = model.events or model.delays or scheduled(model) or any(len(dose.times) for dose in item.doses)
    if step is None or run.tolerance(number) is not None or restarts(item) < RESTARTS or moving:
        return None
    return step


@dataclass(frozen=True)
class Nearby:
    """Solutions of a member, or of one that was displaced, near the solution `found` of a trajectory; with `step` by
    equal steps of at most this size, if they come to `found` too."""

    evaluator: Evaluator
    model: Model
    item: Trajectory
    found: Prediction
    step: float | None = None

    @cached_property
    def variables(self) -> Array:
        """The solution's channels and unmeasured states [R, V], computed as those near it are."""
        return variables_of(self.model, self.found if self._plan is None else self._by(self._plan, self.found.start))

    def solve(self, start: Start, evaluator: Evaluator | None = None) -> Array:
        """The channels and unmeasured states [R, V] from another start, or of another member; NaN where it fails."""
        solver = self.evaluator if evaluator is None else evaluator
        if self._plan is not None and start.origin != "failed":
            return variables_of(self.model, self._by(self._plan, start, solver))
        return variables_of(self.model, predict(solver, self.model, self.item, start))

    @cached_property
    def _plan(self) -> StepPlan | None:
        """The steps, where they come to the solution."""
        if self.step is None:
            return None
        item, width = self.item, np.ptp(self.found.states, axis=0)
        for step in (np.inf, self.step):  # one step for each restart may be enough
            plan = self.evaluator.plan(item.times, item.condition, item.inputs, item.start, max_step=step)
            if len(plan.times) > STEPS_EACH * restarts(item):
                break
            away = np.abs(self._by(plan, self.found.start).states - self.found.states)
            if np.all(away <= SAME * np.where(width > 0, width, 1.0)):
                return plan
        return None

    def _by(self, plan: StepPlan, start: Start, evaluator: Evaluator | None = None) -> Prediction:
        solver = self.evaluator if evaluator is None else evaluator
        with np.errstate(all="ignore"):
            states = solver.by_plan(start.state, plan, self.item.condition, start.constants)
        return completed(solver, self.model, self.item, start, states)

    def moved(self, change: float, *, state: int | None = None, constant: int | None = None) -> Array:
        """The solution [R, V] with an initial value or a constant changed."""
        start = self.found.start
        begin, constants = start.state.copy(), start.constants.copy()
        if state is not None:
            begin[state] += change
        if constant is not None:
            constants[constant] += change
        return self.solve(started(self.evaluator, self.item, begin, constants, start.origin))

    def slope(self, size: float, *, state: int) -> Array:
        """The derivative [R, V] of the solution by an initial value of this size, by differences."""
        nudge = NUDGE * size
        up, down = (self.moved(change, state=state) for change in (nudge, -nudge))
        return np.asarray((up - down) / (2 * nudge), dtype=np.float64)

    def suited_slope(
        self, size: float, place: tuple[int | None, int | None], in_residuals: Array, typical: float
    ) -> Array:
        """The derivative [R, V] of the solution by an initial value or a constant (`place`) of this size, by
        differences of a step that suits the residuals of a window, whose root mean square is `typical` and which have
        the derivatives `in_residuals` [rows, C] by what is predicted."""
        (rows, channels), (state, constant), step = in_residuals.shape, place, NUDGE
        count = max(int(np.count_nonzero(in_residuals)), 1)
        for tried in range(SHORTENED):
            up = self.moved(step * size, state=state, constant=constant)
            changed = (up - self.variables)[:rows, :channels] * in_residuals
            wanted = suited(step, float(np.sqrt(np.sum(changed[in_residuals != 0] ** 2) / count)), typical)
            if step <= TOO_LONG * wanted or tried == SHORTENED - 1:
                break
            step = wanted
        down = self.moved(-step * size, state=state, constant=constant)
        return np.asarray((up - down) / (2 * step * size), dtype=np.float64)
