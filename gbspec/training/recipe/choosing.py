"""The choice between the fit of intervals, or of segments, and that of whole solutions, as the recipe makes it."""

from __future__ import annotations

from gbspec.training.engines import residual_vector
from gbspec.training.problem import Parameters, mean_loss
from gbspec.training.recipe.context import Context
from gbspec.training.recipe.growing import AS_SEGMENTS, short_loss
from gbspec.training.recipe.planned import Reached, shortened
from gbspec.training.recipe.segments import Segments, horizons
from gbspec.training.recipe.stages import ChoiceOfFit
from gbspec.training.stages import StageName


def choice_of_fits(context: Context, layout: Parameters, reached: Reached) -> ChoiceOfFit:
    """The stage that compares what has been reached, at the step of whole solutions; `layout` is that of these."""
    marks, fraction = reached.marks, shortened(reached.begun)
    free = context.engine(layout, 0.0, fraction)
    if StageName.HORIZONS in marks:
        segments = Segments.of(context, layout, horizons(context)[0])
        earlier = marks[StageName.HORIZONS]
        return ChoiceOfFit(lambda theta: short_loss(context, segments, theta), free, earlier, context.seed, AS_SEGMENTS)
    teacher = context.engine(layout, 1.0, fraction)
    earlier = marks.get(StageName.STARTS_AGAIN, marks[StageName.TEACHER])
    if fraction < 1:  # at the whole step that fit may have followed the data by errors of the step
        earlier = marks.get(StageName.HALF_STEP, earlier)
    return ChoiceOfFit(lambda theta: mean_loss(residual_vector(teacher, theta)), free, earlier, context.seed)
