"""How far the deviance of a fit rises where a constant is held elsewhere, and all else is refitted."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.ir import Learnable
from gbspec.runs import Covariance
from gbspec.training.engines import TorchEngine, residual_vector, taken
from gbspec.training.optimise import Passing, Penalised, Rest, beyond_jumps
from gbspec.training.problem import Bijection, Bijections, Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.constants import covers, half_width
from gbspec.training.runs.summary import MemberResult, whole_solutions
from gbspec.training.runs.tied import ACCURACY, LARGEST, penalised, refitted
from gbspec.training.runs.verdict import widening

WAYS = (0.05, 0.12, 0.25, 0.5, 0.75, 0.95)
"""The parts of the way to its bounds, on their scale, that a constant is moved, until the fit is clearly worse."""
FEW = (0.25, 0.75)
"""The same beside unknown functions, whose weights take longer to refit."""
STEPS, NEAR = 4, 0.05
"""How often an end of an interval is interpolated, at most, and how near to the threshold, as a part of it, the
deviance there is to be."""

Passed = TypeVar("Passed")
Rise = Callable[[float], float]
"""By how much the deviance is higher with the constant held at a value, at least; minus infinity if not known."""


def at_least(rise: float, promised: float, threshold: float) -> float:
    """By how much the deviance is higher at least, where it is by `rise` and the next step of the refit promises a fall
    by `promised`; minus infinity where that leaves open on which side of the threshold it is."""
    least = rise - promised
    known = np.isfinite(rise) and (least > threshold or rise <= threshold or promised <= threshold)
    return least if known else -math.inf


@dataclass(frozen=True)
class Held:
    """A constant that the data hold: the values at which the fit is clearly worse."""

    learnable: Learnable
    estimate: float
    worse: tuple[float, ...]

    def spread(self, half: float) -> float:
        """The standard deviation with which an interval, of `half` of them to either side, ends at these values."""
        return math.fsum(abs(value - self.estimate) for value in self.worse) / (len(self.worse) * half)


def last_passed(passed: Mapping[float, Passed], value: float, estimate: float) -> Passed:
    """What was found at the last value on the way from an estimate, which is among them, to a value."""
    between = [v for v in passed if min(value, estimate) <= v <= max(value, estimate)]
    return passed[min(between, key=lambda v: abs(v - value))]


def held_by_data(
    learnable: Learnable, value: float, rise: Rise, threshold: float, ways: Sequence[float] = WAYS
) -> Held | None:
    """The constant, if what the deviance leaves it, up to the threshold, is clearly less than its bounds do; the way to
    the further bound, which decides more often, is tried first."""
    bounds = (learnable.range.low, learnable.range.high)
    nearest = [_towards(learnable, value, bound, ways[0]) for bound in bounds]
    ends, worse = list(bounds), list[float]()
    one = Bijection.of(learnable)
    for side in sorted((0, 1), key=lambda i: -one.distance(value, bounds[i])):
        for place in (_towards(learnable, value, bounds[side], way) for way in ways):
            nearest[side] = place
            if covers(learnable, (nearest[0], nearest[1])):
                return None  # whatever further places say
            if rise(place) > threshold:
                ends[side] = place
                worse.append(place)
                break
        nearest[side] = ends[side]
        if not covers(learnable, (ends[0], ends[1])):
            return Held(learnable, value, tuple(worse))
    return None


def _towards(learnable: Learnable, value: float, bound: float, way: float) -> float:
    """The place on the way from a value to a bound, on the scale of the bounds."""
    if learnable.range.logarithmic and value * bound > 0:
        return float(value * (bound / value) ** way)
    return value + way * (bound - value)


def supported(learnable: Learnable, value: float, rise: Rise, threshold: float) -> tuple[float, float] | None:
    """The interval that the deviance leaves a constant: to where it reaches the threshold, or to a bound where it does
    not on the way there; None where it is not known on a way on which it does not."""
    ends = []
    for bound in (learnable.range.low, learnable.range.high):
        inner, end, known = (value, 0.0), bound, True
        for place in (_towards(learnable, value, bound, way) for way in WAYS):
            found = rise(place)
            if found > threshold:
                end, known = crossing(inner, (place, found), rise, threshold), True
                break
            known = known and math.isfinite(found)
            inner = (place, found) if math.isfinite(found) else inner
        if not known:
            return None
        ends.append(end)
    return ends[0], ends[1]


def crossing(inner: tuple[float, float], outer: tuple[float, float], rise: Rise, threshold: float) -> float:
    """The value at which the deviance reaches the threshold, between two at which it is below and above it (values with
    their deviances): its root is nearly linear."""
    middle = inner[0]
    for _ in range(STEPS):
        roots = [math.sqrt(min(max(each[1], 0.0), 100 * threshold)) for each in (inner, outer)]
        share = (math.sqrt(threshold) - roots[0]) / max(roots[1] - roots[0], 1e-12)
        middle = inner[0] + min(max(share, 0.1), 0.9) * (outer[0] - inner[0])
        found = rise(middle)
        if found > threshold:
            outer = middle, found
        else:
            inner = middle, found
        if abs(found - threshold) < NEAR * threshold:
            break
    return middle


@dataclass(frozen=True)
class Deviance:
    """The sum of squares of a fit (with the prior of weights, if there are any), `least` at its end `theta`, in units
    of the noise's `variance`; intervals, `half` their width in standard deviations, end where it is higher by
    `threshold`. Constants with which it could not be found at some value are `unknown`."""

    target: Penalised
    theta: Array
    least: float
    variance: float
    threshold: float
    half: float
    unknown: set[str] = field(default_factory=set)

    @classmethod
    def of(
        cls,
        result: MemberResult,
        context: Context,
        parameters: Parameters,
        theta: Array,
        stages: Sequence[str],
        known: Covariance | None = None,
    ) -> Deviance | None:
        """That of the fit to which `stages` led; None where it takes too long, or where the prior of the weights of
        networks, which is that of the covariance that is `known`, is not."""
        if parameters.n_weights and (known is None or not known.spread):
            return None
        blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
        engine = context.engine(parameters, blend, step_fraction(stages))
        large = len(residual_vector(engine, theta)) * parameters.size > LARGEST
        if large or (context.model.delays and isinstance(engine, TorchEngine)):
            return None
        target, variance = penalised(context, engine, theta, known if parameters.n_weights else None)
        half = half_width([result])
        threshold = (half * widening(result.channels or {})) ** 2
        made = cls(target, theta, target.value(theta), variance, threshold, half)
        # A fit with networks ends where the limited residuals or held-out data say, and not at this minimum.
        return made.at_rest() if parameters.n_weights else made

    def at_rest(self) -> Deviance:
        """The same with its minimum, all entries refitted."""
        rest = self._fit(self.theta, ())
        return replace(self, theta=rest.theta, least=rest.objective) if rest.objective < self.least else self

    def alone(self, trajectory: int) -> Deviance:
        """That of one trajectory of a model whose trajectories share nothing that is learned."""
        parameters = self.target.parameters
        engine = taken(self.target.engine, np.array([trajectory], dtype=np.int64))
        begin = parameters.n_shared + trajectory * parameters.n_local
        theta = np.concatenate([self.theta[: parameters.n_shared], self.theta[begin : begin + parameters.n_local]])
        target = replace(self.target, engine=engine)
        return replace(self, target=target, theta=theta, least=target.value(theta))

    def held(self, learnable: Learnable, column: int, estimate: float) -> Held | None:
        """The constant at an entry of the vector, if the data hold it."""
        passes = Passing.of(self.target.parameters.model, self.target.parameters)
        enough, low = 0.5 * ACCURACY * self.variance, self.least + 0.5 * self.threshold * self.variance

        def rise(value: float) -> float:
            moved = self.theta.copy()
            moved[column] = Bijections.of((learnable,)).from_natural(np.array([value]))[0]
            rest = self._fit(moved, (column,))
            rest = beyond_jumps(self._fit, self.target.value, rest, column, passes, enough, low)
            rises, promised = (2 * part / self.variance for part in (rest.objective - self.least, rest.promised))
            found = at_least(rises, promised, self.threshold)
            if not math.isfinite(found):
                self.unknown.add(learnable.name)
            return found

        ways = FEW if self.target.parameters.n_weights else WAYS
        return held_by_data(learnable, estimate, rise, self.threshold, ways)

    def _fit(self, theta: Array, held: tuple[int, ...]) -> Rest:
        try:
            return refitted(self.target, theta, held, self.variance)
        except (ComputationError, np.linalg.LinAlgError):
            return Rest(theta, math.inf, math.inf, 0)
