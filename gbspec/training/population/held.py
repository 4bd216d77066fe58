"""The maximum of a marginal likelihood with one parameter held at a value."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.population.objective import Objective, Point

STEPS, HALVINGS = 60, 20
"""Steps, and halvings of each, of a marginal likelihood with one constant held."""
ENOUGH, CLOSE_TO_IT = 0.02, 0.5
"""Steps end where the next promises less; a minimum from which more is promised was not found."""
LOWER = 0.1
"""By how much -2 log L must be lower with a constant held for a lower minimum to be told."""
SMALLEST = 1e-10
"""Curvatures below this part of the largest count as this part of it."""


class SpentError(Exception):
    """The evaluations are used up."""


@dataclass
class Counted:
    """An objective whose evaluations are counted: a number of them, not a time, so that what is said of a fit does not
    depend on the machine."""

    objective: Objective
    left: float = math.inf

    def _spend(self) -> None:
        if self.left < 1:
            raise SpentError
        self.left -= 1

    def at(self, weights: Array, u: Array, z: Array, ridge: float) -> Point:
        """The objective at a point."""
        self._spend()
        return self.objective.at(weights, u, z, ridge)

    def gradient(self, point: Point, ridge: float) -> Array:
        """The exact gradient."""
        self._spend()
        return self.objective.gradient(point, ridge)

    def curvature(self, point: Point, ridge: float) -> Array:
        """The curvature."""
        self._spend()
        return self.objective.curvature(point, ridge)


def with_held(
    counted: Counted,
    estimate: Point,
    ridge: float,
    place: int,
    value: float,
    start: Point | None = None,
    threshold: float = -math.inf,
    steps: int = STEPS,
) -> tuple[float, Point]:
    """The objective with one parameter at a value and all others at their minimum, from `start` (None: the estimate),
    less what more steps promise, and the point; minus infinity where that minimum was not found, with the start itself
    where nothing could be solved. Steps end before it where the objective is no more than the threshold above that of
    the estimate, unless they promise a minimum that is lower than this.

    Steps are those of BFGS in units of the expected information: where this is nearly singular, as of a rate that the
    size of an epidemic almost replaces, its own steps lead nowhere; changes of exact gradients show the curvature.
    """
    layout = counted.objective.layout
    begun = estimate if start is None else start
    count, held = len(begun.weights), len(begun.weights) + place
    whole = np.concatenate([begun.weights, begun.u])
    natural = layout.natural(torch.from_numpy(begun.u)).numpy().copy()
    natural[place] = value
    moved = float(layout.bijections.from_natural(natural)[place]) - whole[held]
    rest, curvature = np.setdiff1d(np.arange(len(whole)), [held]), counted.curvature(begun, ridge)
    values, vectors = np.linalg.eigh(curvature[np.ix_(rest, rest)])
    units = vectors / np.sqrt(np.maximum(values, SMALLEST * max(float(values.max(initial=0.0)), 1e-300)))
    along, best, first = -units @ (units.T @ curvature[rest, held]), 0.0, None
    least = estimate.objective

    def beside(y: Array, z: Array, share: float) -> Point:
        vector = whole.copy()
        vector[held] += moved
        vector[rest] += share * moved * along + units @ y
        return counted.at(vector[:count], vector[count:], z, ridge)

    for share in (1.0, 0.5, 0.0):
        new = beside(np.zeros(len(rest)), begun.z, share)
        if np.isfinite(new.objective) and (first is None or new.objective < first.objective):
            first, best = new, share
        if first is not None and first.objective <= least + threshold:
            break
    if first is None:
        return -math.inf, begun

    def enough(objective: float, promised: float) -> bool:
        return objective <= least + threshold and objective - promised > least - LOWER

    now, promised = _minimum(
        first,
        lambda y, z: beside(y, z, best),
        lambda point: units.T @ counted.gradient(point, ridge)[rest],
        enough,
        steps,
    )
    known = promised < CLOSE_TO_IT or enough(now.objective, promised)
    return (now.objective - promised if known else -math.inf), now


def _minimum(
    first: Point,
    beside: Callable[[Array, Array], Point],
    slope: Callable[[Point], Array],
    enough: Callable[[float, float], bool],
    steps: int = STEPS,
) -> tuple[Point, float]:
    """The minimum near a point, and by how much the objective there may still fall, by BFGS with halved steps, until
    that is `enough`."""
    now, slopes = first, slope(first)
    y, inverse = np.zeros(len(slopes)), np.eye(len(slopes))
    for _ in range(steps):
        step = -inverse @ slopes
        promised = -0.5 * float(slopes @ step)
        if 2 * promised < ENOUGH or enough(now.objective, promised):
            break
        for halving in range(HALVINGS):
            new = beside(y + step * 0.5**halving, now.z)
            if new.objective < now.objective + 1e-4 * 0.5**halving * float(slopes @ step):
                break
        else:
            break
        taken, after = step * 0.5**halving, slope(new)
        change = after - slopes
        if (curved := float(taken @ change)) > 0:
            left = np.eye(len(y)) - np.outer(taken, change) / curved
            inverse = left @ inverse @ left.T + np.outer(taken, taken) / curved
        now, y, slopes = new, y + taken, after
    promised = 0.5 * float(slopes @ inverse @ slopes)
    return now, promised if math.isfinite(promised) else math.inf
