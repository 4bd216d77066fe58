"""Minimisation of a penalised sum of squares from one factored Gauss-Newton Hessian; entries may be held fixed.

The limited-memory BFGS iteration (Nocedal and Wright 2006, algorithm 7.4) whose initial matrix is the inverse of the
normal matrix at the anchor. An iteration costs one gradient and no Jacobian; its pairs represent the curvature of the
residuals, which the anchor lacks. It has converged when the decrease predicted by the quadratic model is small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines import Engine, half_squares, linearise, residual_vector
from gbspec.training.optimise.lbfgs import MEMORY, Pair, inverse_times
from gbspec.training.optimise.normal_equations import NormalEquations
from gbspec.training.optimise.priors import Priors
from gbspec.training.problem import Parameters

SUFFICIENT = 1e-4
"""The fraction of the predicted decrease that a step must achieve (Armijo)."""
HALVINGS = 8
"""Largest number of reductions of a step before the anchor is abandoned."""


@dataclass(frozen=True)
class Rest:
    """The end of a minimisation: the vector, the objective, the decrease still predicted, and the number of steps."""

    theta: Array
    objective: float
    promised: float
    steps: int


@dataclass(frozen=True)
class Penalised:
    """Phi = half of the sum of squared residuals, of the priors' rows and of `ridge` times the weights' squared
    distance from `center` [n_weights].

    The problem's `scaling.noise` must be set, since the priors' rows are in this unit.
    """

    engine: Engine
    ridge: float
    center: Array

    @property
    def parameters(self) -> Parameters:
        """The layout of the vector."""
        return self.engine.parameters

    @property
    def priors(self) -> Priors:
        """The priors' rows."""
        return Priors.of(self.engine.problem, self.parameters, np.zeros(0))

    def value(self, theta: Array) -> float:
        """Phi at a vector [size]; infinite if the solution is not finite."""
        residuals = residual_vector(self.engine, theta)
        with np.errstate(over="ignore"):
            found = 0.5 * float(residuals @ residuals) + self._penalty(theta)
        return found if np.isfinite(found) else float("inf")

    def gradient(self, theta: Array) -> tuple[float, Array]:
        """Phi and its gradient [size]."""
        everything = np.arange(self.parameters.trajectories, dtype=np.int64)
        value, slope = half_squares(self.engine, theta, everything)
        slope = slope + self.priors.gradient(theta)
        slope[: self.parameters.n_weights] += self.ridge * self._displaced(theta)
        value += self._penalty(theta)
        return (value, slope) if np.isfinite(value) and np.isfinite(slope).all() else (float("inf"), slope)

    def _penalty(self, theta: Array) -> float:
        moved = self._displaced(theta)
        return self.priors.penalty(theta) + 0.5 * self.ridge * float(moved @ moved)

    def _displaced(self, theta: Array) -> Array:
        """The weights minus the center of their prior [n_weights]."""
        return np.asarray(theta[: self.parameters.n_weights] - self.center, dtype=np.float64)

    def equations(self, theta: Array) -> NormalEquations:
        """The normal equations at a vector, priors and ridge included.

        Raises LinAlgError if the solution there is not finite.
        """
        found = linearise(self.engine, theta)
        if len(found.shared) < len(found.residuals):
            raise np.linalg.LinAlgError("the solution is not finite")
        system = self.priors.with_rows(found, theta)
        around = theta.copy()
        around[: self.parameters.n_weights] -= self.center
        return NormalEquations(system, self.parameters, np.ones(len(system.residuals)), self.ridge, around)


class Anchor:
    """The factored normal matrix at one vector, damped by `damping`; steps do not change the entries `held`."""

    def __init__(self, equations: NormalEquations, damping: float, held: Sequence[int] = ()) -> None:
        self.equations, self.damping, self.held = equations, damping, list(held)
        if self.held:
            units = np.eye(equations.parameters.size)[self.held]
            columns = np.stack([equations.invert(unit, damping) for unit in units], 1)
            self.variance = float(columns[self.held[0], 0])
            self.path: Array = columns[:, 0] / self.variance
            """The derivative of all other entries with respect to the first held one, to first order, with all but it
            free."""
            self._paths: Array = columns @ np.linalg.inv(columns[self.held])

    def solve(self, vector: Array) -> Array:
        """The inverse of the normal matrix, constrained by the held entries, times a vector."""
        found = self.equations.invert(vector, self.damping)
        return found - self._paths @ found[self.held] if self.held else found


def minimise(target: Penalised, anchor: Anchor, theta: Array, enough: float, most: int) -> Rest:
    """Minimises Phi from `theta` until the predicted decrease is below `enough`, or for `most` steps.

    It also ends if no step along the direction gives a decrease: the anchor is then too far away.
    """
    pairs: list[Pair] = []
    value, slope = target.gradient(theta)
    promised = float("inf")
    for step in range(most):
        direction = -inverse_times(slope, pairs, anchor.solve)
        promised = -0.5 * float(slope @ direction)
        if promised <= enough:
            return Rest(theta, value, promised, step)
        found = _search(target, theta, value, direction, promised)
        if found is None:
            return Rest(theta, value, promised, step)
        after, new, new_slope = found
        moved, changed = after - theta, new_slope - slope
        if float(moved @ changed) > 1e-10 * float(np.linalg.norm(moved) * np.linalg.norm(changed)):
            pairs = [*pairs, (moved, changed)][-MEMORY:]
        theta, value, slope = after, new, new_slope
    return Rest(theta, value, promised, most)


def _search(
    target: Penalised, theta: Array, value: float, direction: Array, promised: float
) -> tuple[Array, float, Array] | None:
    """The first sufficient decrease along a direction, its value and gradient; None if there is none."""
    length = 1.0
    for _ in range(HALVINGS):
        trial = theta + length * direction
        new, slope = target.gradient(trial)
        if new <= value - 2 * SUFFICIENT * length * promised:
            return trial, new, slope
        length *= 0.4
    return None
