"""Constants whose estimates follow from another one's bound, so that they have no interval of their own.

A constant that ended at its bound is fixed there in the curvature of a fit. Where the data tie others to it, their
standard deviations hold if it is at the bound, and say nothing of what the data alone tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines import Engine
from gbspec.training.optimise import loosened
from gbspec.training.problem import Bijection, Bijections, Integers, Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.constants import EXACT, at_bounds
from gbspec.training.runs.summary import MemberResult, whole_solutions

INSIDE = 1e-5
"""Constants at bounds count as so far inside of them (as a fraction of the range on the scale of training), where the
slopes of this scale can still be computed."""
TIED = 3.0
"""Constants are tied to those at bounds where their standard deviations are over this many times as large with these
free."""


def without_tied(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """Takes their intervals from constants that follow from another one's bound; what is to be said of them. `stages`
    are those that led to `theta`."""
    at = dict(at_bounds(context.model, result.constants, result.sd)) if result.loss > EXACT else {}
    ended = [context.model.learnables[i].name for i in parameters.shared if context.model.learnables[i].name in at]
    if not ended or context.model.diffusions:
        return []
    blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
    tied = tied_to_bounds(context.engine(parameters, blend, step_fraction(stages)), theta, ended)
    result.sd |= dict.fromkeys(tied, math.nan)
    return said_of_tied(tied, ended)


def tied_to_bounds(engine: Engine, theta: Array, ended: list[str]) -> dict[str, float]:
    """How many times as large standard deviations would be if the constants that `ended` at bounds were free, by the
    names of the constants that are tied to these."""
    parameters = engine.parameters
    names = [parameters.model.learnables[i].name for i in parameters.shared]
    held = np.array([i for i, name in enumerate(names) if name in ended], dtype=np.int64)
    if not len(held) or len(held) == len(names):
        return {}
    factors = loosened(engine, _inside(parameters, theta, held), held)
    if factors is None:
        return {}
    return {name: float(factors[i]) for i, name in enumerate(names) if i not in held and factors[i] > TIED}


def _inside(parameters: Parameters, theta: Array, held: Integers) -> Array:
    """The vector with the constants `held` (places among the shared ones) off their bounds."""
    out, places = theta.copy(), parameters.n_weights + held
    each = tuple(parameters.model.learnables[parameters.shared[i]] for i in held)
    maps = Bijections.of(each)
    natural = maps.to_natural(torch.from_numpy(out[places])).numpy()
    moved = [Bijection.of(k).inside(float(value), INSIDE) for k, value in zip(each, natural, strict=True)]
    out[places] = maps.from_natural(np.array(moved))
    return out


def said_of_tied(tied: dict[str, float], ended: list[str]) -> list[str]:
    """A sentence for constants without an interval."""
    if not tied:
        return []
    names, bounds = (" and ".join(f"`{name}`" for name in each) for each in (tied, ended))
    verb, their = ("has", "its") if len(tied) == 1 else ("have", "their")
    factor = max(tied.values())
    times = "over 1,000" if factor > 1000 else f"{factor:.2g}"
    them = "it" if len(ended) == 1 else "them"
    return [
        f"{names} {verb} no interval: the data tie {their} value to {bounds}, which ended at a bound; free of {them}, "
        f"{their} standard deviation would be {times} times as large. `gbspec profile` shows what the data say; a "
        "prior, or a value that is known (`const`), helps"
    ]
