"""The stages of the recipe other than optimisers: refits of initial states, and the choice between two fits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.optimise import Outcome, State
from gbspec.training.problem import Forcing, Problem, mean_loss
from gbspec.training.recipe.context import Context
from gbspec.training.stages import StageName
from gbspec.training.starts import refit_own, refit_starts

OWN_DRAWS = 32
"""Draws of each trajectory's own constants, of which the best one is improved."""


def imputed_forcing(context: Context, problem: Problem) -> Forcing:
    """Imputed forcing: every state is replaced by its curve at every key row within the curve's span."""
    packed = problem.packed
    value, weight = np.zeros_like(problem.forcing.value), np.zeros_like(problem.forcing.weight)
    for row in range(packed.rows):
        curves = context.curves.items[int(packed.row_trajectory[row])]
        for state, curve in enumerate(curves):
            if curve is not None and curve.low <= packed.row_time[row] <= curve.high:
                value[row, state] = curve.value(packed.row_time[row : row + 1])[0]
                weight[row, state] = 1.0
    return Forcing(value, weight)


class InitialStates:
    """The stage that refits the initial states and own constants, trajectory by trajectory, in one step."""

    total = 1

    def __init__(self, name: str, engine: Engine, seed: int) -> None:
        self.name, self.engine, self.seed = name, engine, seed

    def begin(self, theta: Array) -> State:
        """The initial state: only the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Refits all initial states at once."""
        theta = refit_starts(self.engine, state["theta"], self.seed)
        theta = refit_own(self.engine, theta, self.seed, OWN_DRAWS, 1)
        return Outcome({"theta": theta}, mean_loss(residual_vector(self.engine, theta)), True)


CLEARLY = 3.0
"""A mean of squares is clearly larger than another one if it is so by this many standard deviations."""

DISTURBED = 2.0
"""Systems count as disturbed where the loss of whole solutions is more than this many times that of intervals."""


class ChoiceOfFit:
    """Chooses between the fit of single intervals (teacher forcing) and that of whole solutions (autoregressive).

    Fits of whole solutions treat measurement noise correctly. But if the system itself is disturbed, or the model is
    incomplete, it may be impossible to fit whole solutions, and intervals are more informative about the dynamics.
    Therefore both errors are computed for both fits (with initial states refitted for whole solutions), and the fit
    with the smaller product of its errors is chosen: only ratios of errors matter, not their sizes.

    Where disturbances are clearly larger than the noise, residuals of whole solutions gather what happened between all
    rows before. Let g be the loss of whole solutions divided by that of intervals. Then n such residuals tell about as
    much as n/g independent ones, and a fit of them follows disturbances that another record will not have. If g is
    above `DISTURBED`, the fit of intervals is also kept where

        loss of its whole solutions < sqrt(g) * that of the fit of whole solutions

    (measured: docs/studies/choice.md). One step.

    `short` gives the loss of intervals, or of short segments, at a vector; `earlier` is the fit of these. Of noisy data
    without disturbances the loss of whole solutions is at most about `margin` times that.
    """

    name = StageName.CHOICE.value
    total = 1

    def __init__(
        self, short: Callable[[Array], float], free: Engine, earlier: Array, seed: int, margin: float = 1.0
    ) -> None:
        self.short, self.free, self.margin = short, free, margin
        self.earlier, self.seed = earlier, seed

    def begin(self, theta: Array) -> State:
        """The initial state: only the vector."""
        return {"theta": theta}

    def step(self, state: State, iteration: int) -> Outcome:
        """Compares the two fits."""
        late = state["theta"]
        interval, whole = self._losses(late, late)
        values = max(int(self.free.problem.seen.sum()), 1)
        if whole <= self.margin * interval * (1 + CLEARLY * np.sqrt(2 / values)):
            return Outcome(state, whole, True)
        refitted = refit_starts(self.free, self.earlier, self.seed)
        other_interval, other_whole = self._losses(self.earlier, refitted)
        disturbed = _disturbed(whole, other_whole, self.margin * other_interval)
        if disturbed or _product(other_interval, other_whole) < _product(interval, whole):
            return Outcome({"theta": refitted}, other_interval, True, f"{WHOLE_WORSE}; the fit of intervals was kept")
        return Outcome(state, whole, True, WHOLE_WORSE)

    def _losses(self, of_intervals: Array, of_whole: Array) -> tuple[float, float]:
        """Mean losses over intervals and of whole solutions."""
        return self.short(of_intervals), mean_loss(residual_vector(self.free, of_whole))


WHOLE_WORSE = (
    "solutions from the initial states follow the data less well than predictions from one row to the next: the system "
    "may be disturbed between rows, or the model may be incomplete"
)


def _disturbed(whole: float, other_whole: float, interval: float) -> bool:
    """Whether whole solutions gather disturbances, and the other fit follows them no worse than these explain."""
    return whole > DISTURBED * interval and other_whole**2 * interval < whole**3


def _product(interval: float, whole: float) -> float:
    """The product of two losses; infinite if one of them is, even if the other is zero."""
    return interval * whole if np.isfinite([interval, whole]).all() else float("inf")
