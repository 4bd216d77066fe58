"""The uncertainty of predictions from that of the learned model: solutions of displaced members.

Weights and shared constants are displaced along the columns of a square root of their covariance, or, where there are
more of them, by random draws from it; all of them shortened by the same factor, so that solutions stay near the linear
range and none blows up, in both directions: what is quadratic cancels in the difference of both. The mean square of
half of it, over the square of the factor, is the variance of the linearised model. A pair of which a solution does not
exist is shortened once more.

Where an event passes a row between the two, that row's difference is no derivative: that of a pair shortened once more
counts, or, where the event is at the row, that of the side that it does not pass. A row that the event passes within
the interval of a constant that moves it may be on either side: its band has both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.solutions import Start
from gbspec.arrays import Array

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.runs import Covariance

DRAWS = 16
"""The most pairs of displaced members; where draws are needed, the standard deviation has a relative error of
1 / sqrt(2 DRAWS) = 18 %."""
SMALL, OF_CONSTANTS = 1e-4, 1e-2
"""The factors by which the draws are shortened, with networks and without: most of a network's weights are hardly
determined, so that whole draws, and even twentieths of them, leave the linear range. In one direction alone the
quadratic part of so many weights was up to 400 times the linear one with a factor of 1e-3."""

SHORTER = 1e-2
"""Where a displaced solution does not exist, the displacement is shortened further by this factor."""

JUMPED = 3.0
"""A difference over the factor that changes by more than this with a shorter displacement is a jump, not a slope."""

Solve = Callable[["Evaluator", Start], Array]
"""The variables [R, V] along a trajectory; NaN where it cannot be solved."""

Refit = Callable[[Array], Array]
"""What is left of a change [R, V] of a solution when what the trajectory has of its own is estimated again."""


def unchanged(change: Array) -> Array:
    """The change where nothing of the trajectory is estimated."""
    return change


class Displaced:
    """Displaced copies of a member; `covariance` None: what is not known has no variance. `given` are constants that
    the user has set, which are not displaced. `jumping`: times at which solutions jump may depend on constants;
    `moving`: those that the times of events and doses depend on, with the ends of their intervals."""

    def __init__(
        self,
        member: GeneratedModule,
        covariance: Covariance | None,
        given: frozenset[str] = frozenset(),
        jumping: bool = False,
        moving: Mapping[str, Sequence[float]] = MappingProxyType({}),
    ) -> None:
        self.member, self.covariance, self.given, self.jumping = member, covariance, given, jumping
        self.moving = moving
        self._pairs: dict[tuple[int, float], list[tuple[Evaluator, Array]]] = {}

    @property
    def _small(self) -> float:
        return SMALL if self.covariance is not None and self.covariance.names else OF_CONSTANTS

    @cached_property
    def _draws(self) -> list[tuple[Array, Array]]:
        """Displacements of the weights and of the learned constants."""
        return [] if self.covariance is None else self.covariance.displacements(np.random.default_rng(67), DRAWS)

    def _pair(self, number: int, factor: float) -> list[tuple[Evaluator, Array]]:
        """The evaluators of the members displaced in both directions by `factor` times a draw, and the displacements of
        all constants."""
        if (number, factor) not in self._pairs:
            weights, constants = self._draws[number]
            signs = (factor, -factor)
            self._pairs[number, factor] = [self._displaced(sign * weights, sign * constants) for sign in signs]
        return self._pairs[number, factor]

    def _displaced(self, weights: Array, constants: Array) -> tuple[Evaluator, Array]:
        from gbspec.backends import Evaluator

        covariance, shapes, change = self.covariance, self.member.shapes(), np.zeros(len(self.member.constants))
        moved = dict(self.member.weights)
        if covariance is not None:
            sizes = [int(np.prod(shapes[name])) for name in covariance.names]
            parts = np.split(weights, np.cumsum(sizes)[:-1]) if sizes else []
            for name, part in zip(covariance.names, parts, strict=True):
                moved[name] = moved[name] + part.reshape(shapes[name])
            for name, by in zip(covariance.constants, constants, strict=True):
                change[self.member.constants.index(name)] = 0.0 if name in self.given else by
        return Evaluator(type(self.member)(moved, self.member.info)), change

    def slopes(
        self, start: Start, variables: Array, solve: Solve, refitted: Refit = unchanged
    ) -> list[tuple[Array, Array]]:
        """The displacements of the constants [k] along draws, and the derivatives along them of `variables` [R, V], the
        solution from `start`, which follows the model as `refitted` says."""
        found = []
        for number, (_, constants) in enumerate(self._draws):
            slope = self._slope(number, start, variables, solve)
            if slope is not None and np.isfinite(change := refitted(slope)).all():
                found.append((constants, change))
        return found

    def passed(
        self,
        start: Start,
        variables: Array,
        slopes: Sequence[tuple[Array, Array]],
        solve: Solve,
        refitted: Refit = unchanged,
    ) -> tuple[Array, Array]:
        """The lowest and highest `variables` [R, V] where a constant that moves an event is at the ends of its
        interval, in rows that the event passes: where they change by far more than `slopes` say. Elsewhere
        `variables`."""
        low, high = variables.copy(), variables.copy()
        for name in sorted({*self.moving} - self.given):
            if self.covariance is None or not slopes or name not in self.covariance.constants:
                continue
            place, (weights, constants) = self.covariance.constants.index(name), self.covariance.towards(name)
            if (deviation := float(constants[place])) <= 0:
                continue
            # By the constant, with what goes along: the covariance with it, over its variance.
            slope = np.mean([draw[place] * change for draw, change in slopes], axis=0) / deviation**2
            for end in self.moving[name]:
                far = end - float(start.constants[self.member.constants.index(name)])
                evaluator, moved = self._displaced(far / deviation * weights, far / deviation * constants)
                there = refitted(solve(evaluator, replace(start, constants=start.constants + moved)) - variables)
                if np.isfinite(there).all():
                    there = variables + np.where(np.abs(there) > JUMPED * np.abs(far * slope), there, 0.0)
                    low, high = np.minimum(low, there), np.maximum(high, there)
        return low, high

    def _slope(self, number: int, start: Start, variables: Array, solve: Solve) -> Array | None:
        """The derivative [R, V] of the solution along a draw; None where displaced solutions do not exist."""
        found: Array | None = None
        for factor in (self._small, self._small * SHORTER):  # columns cannot stand for each other, as draws can
            sides = self._pair(number, factor)
            up, down = (solve(one, replace(start, constants=start.constants + change)) for one, change in sides)
            slope = (up - down) / (2 * factor)
            if not np.isfinite(slope).all():
                continue
            if not self.jumping:
                return np.asarray(slope, dtype=np.float64)
            if found is not None:
                return _without_jumps(found, slope, (up - variables) / factor, (variables - down) / factor)
            found = slope
        return found


def variance_of(variables: Array, slopes: Sequence[tuple[Array, Array]]) -> Array:
    """The variance of `variables` [R, V] with these derivatives along draws."""
    return np.mean([change**2 for _, change in slopes], axis=0) if slopes else np.zeros_like(variables)


def _without_jumps(wide: Array, near: Array, ahead: Array, behind: Array) -> Array:
    """Differences that no jump passes, of those of a displacement (`wide`), and of a shorter one to both sides, ahead
    and behind."""
    one_side = np.where(np.abs(ahead) < np.abs(behind), ahead, behind)
    found = np.where(np.abs(wide) > JUMPED * np.abs(near), near, wide)
    return np.where(np.abs(near) > JUMPED * np.abs(wide), one_side, found)
