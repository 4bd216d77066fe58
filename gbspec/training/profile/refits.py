"""Fits of everything else with one constant held, at a step that is short enough for its value.

A fit begins from a prediction, with the curvature of the estimate. Where a constant has ended so far out that it has no
effect any more, nothing pulls it back, although the lowest fit may be elsewhere: such a fit is made again from the
values of the estimate. The step that was short enough for the fit of the run may be too long where the constant is
larger: where half the step has another deviance, the values concerned are fitted with a finer one, and the fit with all
parameters free too, from which their deviance is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import residual_vector
from gbspec.training.optimise import Anchor, Passing, Penalised, Rest, at_kinks, beyond_jumps, minimise

ACCURACY, KNOWN_ACCURACY = 0.01, 0.002
"""A fit has converged if its deviance is not predicted to decrease by more than this; the second one without networks,
where each further step costs little."""
AGAIN = 12
"""Number of steps with one Jacobian before the next is computed."""
WEAK = 1e-2
"""Damping, as a multiple of the noise's variance, for directions that are undetermined."""
SMALL, FELT = 0.05, 0.1
"""A constant has no effect where a change of its entry of the trainable vector by `SMALL` changes the residuals by less
than the root of `FELT` standard deviations of the noise in all, times this change. Damping hides what is less."""
SHOWN, KNOWN_SHOWN = 0.05, 0.01
"""The error of a step shows where half of it changes the deviance by more than this, and by this share; the second one
without networks, whose fits take longer and come less close to their minimum."""
FINEST = 1 / 32
"""The finest step that a profile takes, as a fraction of that of the fit."""


@dataclass(frozen=True)
class Refit:
    """A fit with the constant held, and the fraction of the fit's step at which it was made.

    `exact` is False if no step that was tried has the deviance of half of it.
    """

    rest: Rest
    fraction: float = 1.0
    exact: bool = True


@dataclass(frozen=True)
class _Level:
    """The objective at one step, and its value at the estimate."""

    target: Penalised
    base: float


@dataclass(frozen=True)
class Follower:
    """Minimises until convergence or as often as allowed; `variance` is that of the noise, and `networks` says whether
    the model has any."""

    variance: float
    iterations: int
    networks: bool

    @property
    def enough(self) -> float:
        """The predicted decrease of the objective below which a fit has converged."""
        return 0.5 * (ACCURACY if self.networks else KNOWN_ACCURACY) * self.variance

    def at_rest(self, rest: Rest) -> bool:
        """Whether a fit has converged."""
        return rest.promised <= self.enough

    def followed(self, target: Penalised, theta: Array, anchor: Anchor | None, held: Sequence[int]) -> Rest:
        """Iterates with a new Jacobian whenever the last one is too far away.

        The curvature of another place does not see that a constant has lost its effect, so that it may promise nothing
        far from a minimum: without networks, whose Jacobians take longer, the one at the end has to agree. Where no
        step along its own curvature is lower, as where solutions jump, no further one is.
        """
        left, given = self.iterations, anchor is not None and not self.networks
        rest = Rest(theta, target.value(theta) if anchor is None else 0.0, float("inf"), 0)
        while np.isfinite(rest.objective):
            own = anchor is None
            try:
                anchor = anchor or Anchor(target.equations(rest.theta), WEAK * self.variance, held)
            except np.linalg.LinAlgError:  # the solution or its derivatives are not finite
                return replace(rest, promised=float("inf"))
            rest = minimise(target, anchor, rest.theta, self.enough, max(min(AGAIN, left), 1))
            left -= max(rest.steps, 1)
            if left <= 0 or (self.at_rest(rest) and not given) or (own and not rest.steps):
                break
            anchor, given = None, False
        return rest

    def all_free(self, target: Penalised, theta: Array) -> Rest:
        """The fit with nothing held. Where times of events rest at kinks, at which no derivative vanishes, it has
        converged where the rest has and the objective rises to both sides of each kink."""
        free = self.followed(target, theta, None, ())
        entries = Passing.of(target.parameters.model, target.parameters).entries
        held = [] if self.at_rest(free) else at_kinks(target.value, free.theta, entries)
        if not held:
            return free
        rest = self.followed(target, free.theta, None, held)
        stays = set(held) <= set(at_kinks(target.value, rest.theta, held))
        return rest if stays and rest.objective <= free.objective else free


class Refits:
    """The fits of one profile: `found` is the vector of the estimate, `column` the entry that is held, and `penalised`
    gives the objective at a fraction of the fit's step."""

    def __init__(
        self, penalised: Callable[[float], Penalised], found: Rest, anchor: Anchor, column: int, follower: Follower
    ) -> None:
        self.penalised, self.anchor, self.column, self.follower = penalised, anchor, column, follower
        self.found, self.lowest = found.theta, found.objective
        self.searching = True  # for a finer step, until none was short enough
        self._levels: dict[float, _Level] = {}
        self._offsets: dict[float, float] = {1.0: 0.0}

    def held(self, entry: float, start: Array, fraction: float) -> Refit:
        """The fit with the constant's entry of the vector at `entry`, from a start, at this fraction of the step or at
        a smaller one."""
        while True:
            level = self._level(fraction)
            rest = self._lower(level.target, start, entry)
            finer, exact = self._exact_fraction(rest.theta, fraction)
            if finer == fraction:
                return Refit(replace(rest, objective=rest.objective + self._offset(fraction)), fraction, exact)
            fraction = finer

    def _lower(self, target: Penalised, start: Array, entry: float) -> Rest:
        """The lowest of the fits from a start and from where rows are on other sides of events. With networks, whose
        fits take longer, the second ones are made where the first has not converged."""
        first = self._followed(target, start, entry)
        if self.follower.networks and self.follower.at_rest(first):
            return first

        def fit(theta: Array, held: tuple[int, ...]) -> Rest:
            return self.follower.followed(target, theta, None, held)

        return beyond_jumps(fit, target.value, first, self.column, self._passing, self.follower.enough)

    @cached_property
    def _passing(self) -> Passing:
        parameters = self._level(1.0).target.parameters
        return Passing.of(parameters.model, parameters)

    def _followed(self, target: Penalised, start: Array, entry: float) -> Rest:
        """The lower one of two fits, from a start and, if it cannot be fitted or a constant has lost its effect, from
        the values of the estimate."""
        first = self.follower.followed(target, start, self.anchor, (self.column,))
        if np.isfinite(first.objective) and not self._without_effect(target, first.theta, self._felt):
            return first
        again = self._elsewhere.copy()
        again[self.column] = entry
        second = self.follower.followed(target, again, None, (self.column,))
        if not np.isfinite(first.objective):
            return second if np.isfinite(second.objective) else first
        margin = self.follower.enough if self.follower.at_rest(second) else 0.0
        return second if second.objective < first.objective + margin else first

    # ---------------------------------------------------------------- constants without effect
    @cached_property
    def _others(self) -> list[int]:
        """The entries of the other shared constants."""
        places = self._level(1.0).target.parameters.places
        return [i for i in range(places.start, places.stop) if i != self.column]

    @cached_property
    def _elsewhere(self) -> Array:
        """The vector of the estimate; constants without an effect there have the values that the model begins with."""
        target = self._level(1.0).target
        parameters, out = target.parameters, self.found.copy()
        begun = np.array([parameters.model.learnables[i].start for i in parameters.shared])
        first = parameters.bijections(parameters.shared).from_natural(begun)
        for i in self._without_effect(target, self.found, self._others):
            out[i] = first[i - parameters.places.start]
        return out

    @cached_property
    def _felt(self) -> list[int]:
        """The entries of the constants that have an effect somewhere: others are undetermined anyhow."""
        none = set(self._without_effect(self._level(1.0).target, self._elsewhere, self._others))
        return [i for i in self._others if i not in none]

    def _without_effect(self, target: Penalised, theta: Array, among: list[int]) -> list[int]:
        if not among:
            return []
        before, found = residual_vector(target.engine, theta), []
        for i in among:
            moved = theta.copy()
            moved[i] += SMALL
            change = (residual_vector(target.engine, moved) - before) / SMALL
            with np.errstate(over="ignore", invalid="ignore"):
                if float(change @ change) < FELT * self.follower.variance:
                    found.append(i)
        return found

    # ---------------------------------------------------------------- steps
    def _level(self, fraction: float) -> _Level:
        if fraction not in self._levels:
            target = self.penalised(fraction)
            self._levels[fraction] = _Level(target, target.value(self.found))
        return self._levels[fraction]

    def _offset(self, fraction: float) -> float:
        """What is added to the objective at a step, so that fits at all steps are counted from the estimate: this takes
        a fit with all parameters free, which a step that is only compared does not need."""
        if fraction not in self._offsets:
            level, offset = self._level(fraction), 0.0
            if np.isfinite(level.base):
                offset = self.lowest - self.follower.all_free(level.target, self.found).objective
            self._offsets[fraction] = offset
        return self._offsets[fraction]

    def _exact_fraction(self, theta: Array, fraction: float) -> tuple[float, bool]:
        """The largest fraction of the step, this one or a smaller one, half of which has the same deviance at a vector,
        and True; if there is none, the same fraction and False."""
        finest = FINEST if self.searching else fraction / 2
        now, tried = self._deviance(theta, fraction), fraction
        least = SHOWN if self.follower.networks else KNOWN_SHOWN
        while tried > finest:
            half = self._deviance(theta, tried / 2)
            if abs(half - now) <= least * max(half, 1.0):
                return tried, True
            now, tried = half, tried / 2
        self.searching = False  # each search costs many solutions, and the next one ends like this one
        return fraction, False

    def _deviance(self, theta: Array, fraction: float) -> float:
        level = self._level(fraction)
        return 2 * (level.target.value(theta) - level.base) / self.follower.variance
