"""Constants of fits with disturbances whose intervals, by the curvature, cover their bounds: what the likelihood leaves
them.

These fits have no profile. So where the likelihood of the innovations, with a constant held further and further on the
way to its bounds and all else refitted, says more than the curvature at the estimate, its interval is that of the
likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Learnable
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise import Likeliest, likeliest
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context, filter_of, whole_vector
from gbspec.training.runs.constants import half_width
from gbspec.training.runs.deviance import Rise, at_least, last_passed, supported
from gbspec.training.runs.misjudged import open_constants
from gbspec.training.runs.summary import MemberResult

MOST = 4
"""So many constants of a fit are looked at: each takes up to a dozen fits with it held."""


def with_likelihood(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """Gives such constants of a fit with disturbances the intervals of the likelihood, where these are shorter; a
    sentence for each. With unknown functions, whose weights are not refitted, they are `untested`, and so are those of
    which the likelihood cannot be found on the way to a bound, or which would take too long."""
    model = context.model
    if not model.diffusions:
        return []
    shared = [model.learnables[i] for i in parameters.shared]
    open_ones = [k for k in open_constants(result, model, shared) if k.name not in result.intervals]
    if not open_ones or parameters.n_weights:
        result.untested |= frozenset(k.name for k in open_ones)
        return []
    engine, out = filter_of(context, parameters), []
    best = likeliest(engine, whole_vector(context, engine, theta))
    threshold = half_width([result]) ** 2
    result.untested |= frozenset(k.name for k in open_ones[MOST:])
    for k in open_ones[:MOST]:
        value = result.constants[k.name]
        interval = supported(k, value, _rise_of(engine, best, k, shared.index(k), value, threshold), threshold)
        if interval is None:
            result.untested |= {k.name}
        elif interval != (k.range.low, k.range.high):
            result.intervals[k.name] = interval
            out.append(_sentence(k, interval))
    return out


def _rise_of(
    engine: FilterEngine, best: Likeliest, learnable: Learnable, place: int, estimate: float, threshold: float
) -> Rise:
    """By how much -2 log likelihood is higher than at its maximum with a constant at values; refits begin at the last
    place on the same side of the estimate."""
    parameters, column = engine.parameters, engine.parameters.n_weights + place
    maps = parameters.bijections((parameters.shared[place],))
    passed = {estimate: best.vector}

    def rise(value: float) -> float:
        vector = last_passed(passed, value, estimate).copy()
        vector[column] = maps.from_natural(np.array([value]))[0]
        point = likeliest(engine, vector, held=column)
        if math.isfinite(point.value):
            passed[value] = point.vector
        return at_least(2 * (point.value - best.value), 2 * point.promised, threshold)

    return rise


def _sentence(learnable: Learnable, interval: tuple[float, float]) -> str:
    """What is said of a constant that has the interval of the likelihood."""
    name, (low, high) = learnable.name, interval
    reached = f"down to its bound {low:g}" if low == learnable.range.low else ""
    reached = f"up to its bound {high:g}" if high == learnable.range.high else reached
    rest = f". The data leave `{name}` open {reached}" if reached else ""
    return (
        f"the interval of `{name}`, {low:.4g} to {high:.4g}, is that of the likelihood: -2 log likelihood, with all "
        f"else refitted, is higher by less than 2.7 there. By the curvature at the estimate it would cover the bounds"
        f"{rest}"
    )
