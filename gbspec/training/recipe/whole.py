"""Whole solutions of exact data where small residuals of intervals do not yet tell that the rates are right.

Of a state that is not measured a single interval holds too little. Adaptive steps are taken of stiff equations, in
which fast rates nearly cancel, so that a large error of one of them moves solutions little (Robertson's reaction: 0.8 %
at a loss of 8e-10, 0.01 % at 4e-12). Where all states are measured the errors of intervals may still add up, or grow
(a chemostat whose species outgrow each other: whole solutions had 60,000 times the loss of intervals).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gbspec.training.engines import residual_vector
from gbspec.training.optimise import LevenbergMarquardt, LevenbergOptions, Stage
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.judging import unmeasured
from gbspec.training.recipe.planned import Decision, Planned, Reached, step_fraction
from gbspec.training.stages import Effort, StageName, most_iterations

ENOUGH: Mapping[Effort, float] = {"low": 1e-6, "normal": 1e-9, "high": 1e-11}
"""Mean loss below which exact data need no further iteration (1e-9: residuals of 0.005 % of the standard
deviations)."""
ROUNDING = 1e-15
"""The same for whole solutions: where few rows tell of an unmeasured state, the error of its rates is thousands of
times these residuals (two tanks: 3 % at a loss of 7e-11, 0.2 % at 3e-15)."""

APART = 10.0
"""Where intervals hold enough, whole solutions are fitted too if their loss is more than this many times that of
intervals, and than what is enough. Errors of some tens of intervals that only add up make up such a factor; a fit of
whole solutions then gained nothing (the reactor's constants became two to three times as wrong)."""


def demanding(context: Context) -> bool:
    """Whether whole solutions have to follow exact data to rounding before rates are known."""
    return unmeasured(context.model) or context.adaptive


def whole_of_exact_data(
    context: Context,
    layout: Callable[[Reached], Parameters],
    effort: Effort,
    options: Callable[[Reached], LevenbergOptions],
    exact: Decision,
) -> Planned:
    """The stage, at the step of the stage before; only where the data are `exact`."""
    total = most_iterations(StageName.WHOLE, effort)

    def make(reached: Reached) -> Stage:
        fraction = step_fraction(reached.begun)
        parameters, at = layout(reached), options(reached)
        return LevenbergMarquardt(StageName.WHOLE, total, lambda i: context.engine(parameters, 0.0, fraction, i), at)

    def wanted(reached: Reached) -> bool:
        if not exact(reached):
            return False
        layout_now, fraction = layout(reached), step_fraction(reached.begun)

        def loss(blend: float) -> float:
            return mean_loss(residual_vector(context.engine(layout_now, blend, fraction), reached.theta))

        if demanding(context):
            return loss(0.0) > ROUNDING
        return loss(0.0) > APART * max(loss(1.0), ENOUGH[effort])

    return Planned(StageName.WHOLE, total, make, wanted)
