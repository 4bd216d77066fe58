"""Learned disturbances that the data do not tell apart from none.

The scale on which the size of a disturbance is trained has none at infinity, and an interval from the curvature there
says nothing of it: its lower end is above zero whatever the data say. The restricted likelihood without the disturbance
tells, all else refitted, and at larger ones how large it may be. (The likelihood itself takes all else as known: it has
disturbances too small, and would bound them too closely.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Learnable, Model
from gbspec.runs import NORMAL_90
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise import likeliest, restricted_value, shifts, sizes
from gbspec.training.problem import Bijection, Integers, Parameters
from gbspec.training.recipe import Context, filter_of, whole_vector
from gbspec.training.runs.deviance import crossing
from gbspec.training.runs.summary import MemberResult

NONE, LARGEST = 0.01, 0.1
"""This part of a size stands for none, or the least that its bounds allow, if that is at most the second part."""
DOUBTFUL = 1 / 3.5
"""A size is looked at whose standard deviation is a larger part of it."""
TOLD = NORMAL_90**2
"""A disturbance is told apart from none where -2 log likelihood (restricted) is higher by more without it: the 95 %
point, as a size cannot be negative (Self and Liang 1987). At the upper end of its interval it is higher by that."""
WIDER, POWERS, STEEPER = 2.0, (1, 3, 6), 5
"""The factor by which larger sizes are tried, and its powers, each for so many of them (a size may have ended at next
to none)."""
GROWTHS = STEEPER * len(POWERS)
"""How many larger sizes there are."""


@dataclass
class _Sizes:
    """The restricted likelihoods with the entry `place` of the vector, a constant's size, held at values; `others` are
    the entries that are no sizes, and `least` is the smallest -2 log likelihood so far."""

    engine: FilterEngine
    place: int
    others: Integers
    least: float = math.inf

    def at(self, value: float, near: Array) -> tuple[float, Array]:
        """-2 log likelihood with the size at a value, and the vector of its maximum, from one near it."""
        parameters = self.engine.parameters
        index = parameters.shared[self.place - parameters.n_weights]
        vector = near.copy()
        vector[self.place] = parameters.bijections((index,)).from_natural(np.array([value]))[0]
        point = likeliest(self.engine, vector, held=self.place)
        found = 2 * restricted_value(self.engine, point, self.others)
        self.least = min(self.least, found)
        return found, point.vector

    def upper(self, none: tuple[float, float], value: float, near: Array, bound: float) -> float:
        """The size at which -2 log likelihood is higher by `TOLD` than at its minimum, searched from a value upwards;
        the upper bound if there is none. `none` is what stands for no disturbance, with its -2 log likelihood."""
        before = none
        for tried in range(GROWTHS):
            found, after = self.at(value, near)
            if found - self.least > TOLD:
                return self._between(before, (value, found), near)
            if value >= bound:
                break
            before, near = (value, found), after
            value = min(WIDER ** POWERS[tried // STEEPER] * value, bound)
        return bound

    def _between(self, inner: tuple[float, float], outer: tuple[float, float], near: Array) -> float:
        """The size at which -2 log likelihood rises by `TOLD`, between two of which it rises by less and by more."""
        below, above = ((size, found - self.least) for size, found in (inner, outer))
        return crossing(below, above, lambda size: self.at(size, near)[0] - self.least, TOLD)


def without_disturbances(
    result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
) -> list[str]:
    """A sentence for each learned size of a disturbance that the data do not tell apart from none, of which the result
    gets the interval that the likelihood gives."""
    model = context.model
    if not model.diffusions:
        return []
    engine = filter_of(context, parameters)
    vector, out = whole_vector(context, engine, theta), []
    entries = sizes(engine)
    moving = engine.layout.free > 0
    moving[: parameters.n_weights] = moving[entries] = False
    moving &= ~engine.ended(vector, np.zeros(len(vector)))
    shifting = shifts(engine)
    if moving[shifting].any():  # shared constants beside them are parameters of variances
        moving[np.setdiff1d(np.arange(parameters.n_shared), shifting)] = False
    others = np.flatnonzero(moving)
    for place in entries[entries < parameters.size]:
        learnable = model.learnables[parameters.shared[place - parameters.n_weights]]
        name, low = learnable.name, max(learnable.range.low, 0.0)
        value, sd = result.constants[name], result.sd.get(name, math.nan)
        none = max(NONE * value, low)
        # Of one at next to none the curvature, and with it the deviation, is lost in rounding.
        doubtful = sd > DOUBTFUL * value or (math.isnan(sd) and any(map(math.isfinite, result.sd.values())))
        if learnable.range.low < 0 or not doubtful or not none <= LARGEST * value:
            continue
        if Bijection.of(learnable).ended_at(value, sd) is not None:
            continue
        held = _Sizes(engine, int(place), others)
        here, near = held.at(value, vector)
        without = held.at(none, near)[0]
        rise = without - here
        if rise < TOLD and math.isfinite(here):
            interval = low, held.upper((none, without), value, near, learnable.range.high)
            result.intervals[name] = interval
            out.append(_sentence(model, learnable, (value, none), max(rise, 0.0), interval))
    return out


def _sentence(
    model: Model, learnable: Learnable, sizes: tuple[float, float], rise: float, interval: tuple[float, float]
) -> str:
    name, high = learnable.name, learnable.range.high
    inside = [one.state for one in model.diffusions if name in {symbol.name for symbol in one.value.free_symbols}]
    states = " and ".join(f"`{state}`" for state in inside)
    upper = f"its upper end, {interval[1]:.3g}, is where it is higher by 2.7"
    if interval[1] >= high:
        upper = "the data do not bound it above" + f": its upper end is its bound, {high:.3g}" * math.isfinite(high)
    return (
        f"the disturbance of {states}, `{name}` = {sizes[0]:.3g}, is not told apart from none by these data: with "
        f"{sizes[1]:.2g} in place of it, and all else refitted, -2 log likelihood (restricted) is higher by "
        f"{rise:.2g} only (2.7 would tell). Its interval begins at {interval[0]:.3g}; {upper}. Leave it out, or "
        "measure more"
    )
