"""Constants of a finished fit at which the sum of squares jumps."""

from __future__ import annotations

import math
from collections.abc import Sequence

from gbspec.arrays import Array
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.constants import EXACT
from gbspec.training.runs.summary import MemberResult, whole_solutions
from gbspec.training.starts import at_jumps

_OF_EVENTS = (
    "a value measured then is that before an event or a dose on one side, and that after it on the other. Every row "
    "that such a time may pass ends a piece with a minimum of its own, so that a better one may exist, `{name}` has no "
    "interval, and those of the others take it for known. `gbspec profile` tries other values; so does `--effort high`"
)
_OF_SWITCHES = (
    "a right side switches within a step of the solver, a part of which passes to the other side just beside this "
    "value, as where a solution slides along a switch. So `{name}` has no interval, and those of the others take it "
    "for known. `gbspec profile` tries other values; a smooth switch, such as `tanh` of the difference over a width, "
    "has slopes"
)


def without_jumping(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """Takes their standard deviations from such constants; a sentence for each. `stages` are those that led to
    `theta`."""
    if parameters.n_weights or context.model.diffusions or context.model.marginal or not result.loss > EXACT:
        return []
    blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
    engine = context.engine(parameters, blend, step_fraction(stages))
    names = [context.model.learnables[parameters.shared[i]].name for i in at_jumps(engine, theta)]
    result.sd |= dict.fromkeys(names, math.nan)
    result.at_most = dict.fromkeys(names, 0.0) | result.at_most
    reason = _OF_EVENTS if context.model.events or context.model.doses else _OF_SWITCHES
    return [
        f"`{name}` ended at {result.constants[name]:.6g}, where the sum of squares jumps: {reason.format(name=name)}"
        for name in names
    ]
