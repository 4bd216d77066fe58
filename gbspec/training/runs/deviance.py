"""How far the deviance of a fit rises where a constant is held elsewhere, and all else is refitted."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gbspec.arrays import Array
from gbspec.diagnostics import ComputationError
from gbspec.ir import Learnable
from gbspec.training.engines import TorchEngine, residual_vector, taken
from gbspec.training.optimise import Passing, Penalised, Rest, beyond_jumps
from gbspec.training.problem import Bijections, Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.constants import covers, half_width
from gbspec.training.runs.summary import MemberResult, whole_solutions
from gbspec.training.runs.tied import ACCURACY, LARGEST, penalised, refitted
from gbspec.training.runs.verdict import widening

WAYS = (0.05, 0.12, 0.25, 0.5, 0.75, 0.95)
"""The parts of the way to its bounds, on their scale, that a constant is moved, until the fit is clearly worse."""

Rise = Callable[[float], float]
"""By how much the deviance is higher with the constant held at a value, at least; minus infinity if not known."""


@dataclass(frozen=True)
class Held:
    """A constant that the data hold: the values at which the fit is clearly worse."""

    learnable: Learnable
    estimate: float
    worse: tuple[float, ...]

    def spread(self, half: float) -> float:
        """The standard deviation with which an interval, of `half` of them to either side, ends at these values."""
        return math.fsum(abs(value - self.estimate) for value in self.worse) / (len(self.worse) * half)


def held_by_data(learnable: Learnable, value: float, rise: Rise, threshold: float) -> Held | None:
    """The constant, if what the deviance leaves it, up to the threshold, is clearly less than its bounds do."""
    low, high, log = learnable.range.low, learnable.range.high, learnable.range.logarithmic

    def towards(bound: float, way: float) -> float:
        if log and value * bound > 0:
            return float(value * (bound / value) ** way)
        return value + way * (bound - value)

    bounds, nearest = (low, high), [towards(low, WAYS[0]), towards(high, WAYS[0])]
    ends, worse = [low, high], list[float]()
    for side, bound in enumerate(bounds):
        for place in (towards(bound, way) for way in WAYS):
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


@dataclass(frozen=True)
class Deviance:
    """The sum of squares of a fit of constants alone, `least` at its end `theta`, in units of the noise's `variance`;
    intervals, `half` their width in standard deviations, end where it is higher by `threshold`."""

    target: Penalised
    theta: Array
    least: float
    variance: float
    threshold: float
    half: float

    @classmethod
    def of(
        cls, result: MemberResult, context: Context, parameters: Parameters, theta: Array, stages: Sequence[str]
    ) -> Deviance | None:
        """That of the fit to which `stages` led; None where it takes too long."""
        blend = 0.0 if whole_solutions(context, parameters, stages) else context.options.blend
        engine = context.engine(parameters, blend, step_fraction(stages))
        large = len(residual_vector(engine, theta)) * parameters.size > LARGEST
        if large or (context.model.delays and isinstance(engine, TorchEngine)):
            return None
        target, variance = penalised(context, engine, theta)
        half = half_width([result])
        threshold = (half * widening(result.channels or {})) ** 2
        return cls(target, theta, target.value(theta), variance, threshold, half)

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
            known = math.isfinite(rest.objective)
            return 2 * (rest.objective - rest.promised - self.least) / self.variance if known else -math.inf

        return held_by_data(learnable, estimate, rise, self.threshold)

    def _fit(self, theta: Array, held: tuple[int, ...]) -> Rest:
        try:
            return refitted(self.target, theta, held, self.variance)
        except (ComputationError, np.linalg.LinAlgError):
            return Rest(theta, math.inf, math.inf, 0)
