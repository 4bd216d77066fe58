"""The uncertainty of predictions from that of the learned model: solutions of displaced members.

Weights and shared constants are displaced by random draws from their covariance, all of them shortened by the same
factor, so that solutions stay in the linear range and none blows up; the mean square of the differences, over the
square of the factor, is the variance of the linearised model.
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
"""Displaced members; the standard deviation has a relative error of 1 / sqrt(2 DRAWS) = 18 %."""
SMALL = 1e-3
"""The factor by which the draws are shortened: most of a network's weights are hardly determined, so that whole draws,
and even twentieths of them, leave the linear range."""

Solve = Callable[["Evaluator", Start], Array]
"""The variables [R, V] along a trajectory; NaN where it cannot be solved."""


class Displaced:
    """Displaced copies of a member; `covariance` None: what is not known has no variance. `given` are constants that
    the user has set, which are not displaced."""

    def __init__(
        self, member: GeneratedModule, covariance: Covariance | None, given: frozenset[str] = frozenset()
    ) -> None:
        self.member, self.covariance, self.given = member, covariance, given

    @cached_property
    def _copies(self) -> list[tuple[Evaluator, Array]]:
        """Evaluators of the displaced members, and the displacements of all constants."""
        from gbspec.backends import Evaluator

        if self.covariance is None:
            return []
        rng, shapes = np.random.default_rng(67), self.member.shapes()
        copies = []
        for _ in range(DRAWS):
            weights, constants = (SMALL * each for each in self.covariance.draw(rng))
            sizes = [int(np.prod(shapes[name])) for name in self.covariance.names]
            parts = np.split(weights, np.cumsum(sizes)[:-1]) if sizes else []
            moved = dict(self.member.weights)
            for name, part in zip(self.covariance.names, parts, strict=True):
                moved[name] = moved[name] + part.reshape(shapes[name])
            change = np.zeros(len(self.member.constants))
            for name, by in zip(self.covariance.constants, constants, strict=True):
                change[self.member.constants.index(name)] = 0.0 if name in self.given else by
            copies.append((Evaluator(type(self.member)(moved, self.member.info)), change))
        return copies

    def variance(self, start: Start, variables: Array, solve: Solve) -> Array:
        """The variance of `variables` [R, V], the solution from `start`, which is held fixed."""
        squares = [
            ((solve(evaluator, replace(start, constants=start.constants + change)) - variables) / SMALL) ** 2
            for evaluator, change in self._copies
        ]
        good = [each for each in squares if np.isfinite(each).all()]
        return np.mean(good, axis=0) if good else np.zeros_like(variables)
