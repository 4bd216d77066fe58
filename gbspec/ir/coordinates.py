"""Coordinates in which a disturbance does not depend on its state (Lamperti): the logarithm of a state to which it is
proportional, the logit of one to whose distances from two numbers it is proportional.

With dX = f dt + S(X) dW (Ito), Z = z(X) has dZ = (z' f + z'' S^2 / 2) dt + z' S dW. For S = s X and Z = ln X that is
dZ = (f / X - s^2 / 2) dt + s dW; for S = s (X - a)(b - X) / (b - a) and Z = ln((X - a) / (b - X)) it is
dZ = (z' f + s^2 (2 X - a - b) / (2 (b - a))) dt + s dW with z' = (2 + e^Z + e^-Z) / (b - a). The disturbance does not
depend on Z, so that the filter's equations for mean and covariance need no further approximation, and X stays where it
can be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gbspec.arrays import Array
from gbspec.ir.model import Model

LEAST = 1e-12
"""States that must be positive are not taken below this where data or guesses are not; nor shares nearer to a bound."""
WELL = 0.01
"""A start that has no coordinate is moved inside by this part of the state's typical size."""
Function = Callable[[Any], Any]


@dataclass(frozen=True)
class Coordinate:
    """The coordinate of a state: the state itself, its logarithm (`low` = 0, no `high`), or its logit between two
    numbers. The functions take values of any arithmetic, with its `exp` or `log`."""

    low: float | None = None
    high: float | None = None

    @property
    def plain(self) -> bool:
        """Whether it is the state itself."""
        return self.low is None

    @property
    def logarithm(self) -> bool:
        """Whether it is the state's logarithm."""
        return self.low is not None and self.high is None

    def of(self, log: Function, x: Any) -> Any:
        """The coordinate of a state."""
        if self.low is None:
            return x
        return log(x) if self.high is None else log(x - self.low) - log(self.high - x)

    def state(self, exp: Function, z: Any) -> Any:
        """The state of a coordinate."""
        if self.low is None:
            return z
        return exp(z) if self.high is None else self.low + (self.high - self.low) / (1.0 + exp(-z))

    def drift(self, exp: Function, rate: Any, square: Any, z: Any, x: Any) -> Any:
        """The drift of the coordinate, from that of the state (`rate`), the square of the size of the coordinate's
        disturbance, the coordinate and the state."""
        if self.low is None:
            return rate
        if self.high is None:
            return rate / x - 0.5 * square
        width = self.high - self.low
        return rate * ((2.0 + exp(z) + exp(-z)) / width) + square * ((x - 0.5 * (self.low + self.high)) / width)

    def inside(self, x: Array) -> Array:
        """States without those that have no coordinate."""
        if self.low is None:
            return x
        least = LEAST if self.high is None else LEAST * (self.high - self.low)
        return np.clip(x, self.low + least, None if self.high is None else self.high - least)

    def well_inside(self, x: Array, size: Array) -> Array:
        """States, with those that have no coordinate moved inside by `WELL` of their size, or of the range: the spread
        of a logarithm that begins at next to nothing would be that of all numbers."""
        if self.low is None:
            return x
        least = WELL * (size if self.high is None else (self.high - self.low) * np.ones_like(x))
        moved = np.where(x > self.low, x, self.low + least)
        return moved if self.high is None else np.where(moved < self.high, moved, self.high - least)

    def spread(self, x: Array, size: Array, least: float) -> Array:
        """`Coordinates.spreads` for one state: a logarithm has the standard deviation of that of a lognormal value, a
        logit at most that of a value that is uniform between the numbers."""
        if self.low is None:
            return size
        slope = self.slope(x)
        if self.high is None:
            return np.maximum(np.sqrt(np.log1p((size * slope) ** 2)), least) / slope
        return np.clip(size * slope, least, np.pi / np.sqrt(3)) / slope

    def slope(self, x: Array) -> Array:
        """The derivative of the coordinate by the state, at states that have a coordinate."""
        if self.low is None:
            return np.ones_like(x)
        return 1 / (x - self.low) + (0.0 if self.high is None else 1 / (self.high - x))


def coordinates_of(model: Model) -> tuple[Coordinate, ...]:
    """The coordinate of each state."""
    made = {d.state: Coordinate(*(d.between or (0.0, None))) for d in model.diffusions if d.relative is not None}
    return tuple(made.get(state.name, Coordinate()) for state in model.states)


__all__ = ["LEAST", "Coordinate", "coordinates_of"]
