"""The uncertainty of predictions from that of the learned model: solutions of displaced members.

Weights and shared constants are displaced along the columns of a square root of their covariance, or, where there are
more of them, by random draws from it; all of them shortened by the same factor, so that solutions stay near the linear
range and none blows up, in both directions: what is quadratic cancels in the difference of both. The mean square of
half of it, over the square of the factor, is the variance of the linearised model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
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

Solve = Callable[["Evaluator", Start], Array]
"""The variables [R, V] along a trajectory; NaN where it cannot be solved."""

Refit = Callable[[Array], Array]
"""What is left of a change [R, V] of a solution when what the trajectory has of its own is estimated again."""


def unchanged(change: Array) -> Array:
    """The change where nothing of the trajectory is estimated."""
    return change


class Displaced:
    """Displaced copies of a member; `covariance` None: what is not known has no variance. `given` are constants that
    the user has set, which are not displaced."""

    def __init__(
        self, member: GeneratedModule, covariance: Covariance | None, given: frozenset[str] = frozenset()
    ) -> None:
        self.member, self.covariance, self.given = member, covariance, given

    @property
    def _small(self) -> float:
        return SMALL if self.covariance is not None and self.covariance.names else OF_CONSTANTS

    @cached_property
    def _copies(self) -> list[list[tuple[Evaluator, Array]]]:
        """For each draw the evaluators of the members displaced in both directions, and the displacements of all
        constants."""
        from gbspec.backends import Evaluator

        if self.covariance is None:
            return []
        rng, shapes = np.random.default_rng(67), self.member.shapes()
        covariance, sizes = self.covariance, [int(np.prod(shapes[name])) for name in self.covariance.names]

        def displaced(weights: Array, constants: Array) -> tuple[Evaluator, Array]:
            parts = np.split(weights, np.cumsum(sizes)[:-1]) if sizes else []
            moved = dict(self.member.weights)
            for name, part in zip(covariance.names, parts, strict=True):
                moved[name] = moved[name] + part.reshape(shapes[name])
            change = np.zeros(len(self.member.constants))
            for name, by in zip(covariance.constants, constants, strict=True):
                change[self.member.constants.index(name)] = 0.0 if name in self.given else by
            return Evaluator(type(self.member)(moved, self.member.info)), change

        small = self._small
        draws = covariance.displacements(rng, DRAWS)
        return [[displaced(sign * small * w, sign * small * k) for sign in (1.0, -1.0)] for w, k in draws]

    def variance(self, start: Start, variables: Array, solve: Solve, refitted: Refit = unchanged) -> Array:
        """The variance of `variables` [R, V], the solution from `start`, which follows the model as `refitted` says."""
        squares = []
        for pair in self._copies:
            up, down = (solve(one, replace(start, constants=start.constants + change)) for one, change in pair)
            squares.append(refitted((up - down) / (2 * self._small)) ** 2)
        good = [each for each in squares if np.isfinite(each).all()]
        return np.mean(good, axis=0) if good else np.zeros_like(variables)
