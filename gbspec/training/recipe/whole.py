"""Whole solutions of exact data where small residuals of intervals do not yet tell that the rates are right.

Of a state that is not measured a single interval holds too little. Adaptive steps are taken of stiff equations, in
which fast rates nearly cancel, so that a large error of one of them moves solutions little (Robertson's reaction: 0.8 %
at a loss of 8e-10, 0.01 % at 4e-12).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from gbspec.arrays import Array
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


def whole_of_exact_data(
    context: Context,
    layout: Callable[[Reached], Parameters],
    effort: Effort,
    options: Callable[[Array], LevenbergOptions],
    exact: Decision,
) -> Planned:
    """The stage, at the step of the stage before; only where the data are `exact`."""
    total = most_iterations(StageName.WHOLE, effort)
    hidden = unmeasured(context.model)

    def make(reached: Reached) -> Stage:
        fraction = step_fraction(reached.begun)
        parameters, at = layout(reached), options(reached.theta)
        return LevenbergMarquardt(StageName.WHOLE, total, lambda i: context.engine(parameters, 0.0, fraction, i), at)

    def wanted(reached: Reached) -> bool:
        if not (hidden or context.adaptive) or not exact(reached):
            return False
        engine = context.engine(layout(reached), 0.0, step_fraction(reached.begun))
        return mean_loss(residual_vector(engine, reached.theta)) > ROUNDING

    return Planned(StageName.WHOLE, total, make, wanted)
