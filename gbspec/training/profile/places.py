"""Where the places of a profile lie on the scale of training: entries of the trainable vector.

Around an estimate inside of its bounds places are distances along these entries. Beside a bound, which that scale
reaches at infinity only, equal distances along it are equal factors of the distance from the bound, which begin where
nothing changes yet and soon pass from far inside of the interval to far outside: there they are parts of the range.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from gbspec.training.problem import Bijection, Bijections

WIDEST = 0.5
"""Largest change of the entry of the trainable vector in a first step (half of it is a factor of e^0.75)."""
WIDE = 0.25
"""Largest first step beside a bound, as a part of the range."""
LEAST = 1e-9
"""Places beside a bound end so close to the bounds, as a part of the range."""
CLOSER, TRIALS = 4.0, 20
"""Slopes beside a bound are looked for at distances from it that are each smaller by this factor, so often."""


@dataclass(frozen=True)
class Places:
    """The entry of the trainable vector at a place on one side of the estimate, and the last place that there is."""

    entry: Callable[[float], float]
    last: float = math.inf


def along_entries(entry: float, step: float, direction: float) -> Places:
    """Places around an estimate with this entry, with a `step` (its deviation at the threshold) as their unit."""
    stride = direction * min(step, WIDEST)
    return Places(lambda place: entry + place * stride)


@dataclass(frozen=True)
class Beside:
    """The range of a constant whose estimate `value` lies beside a `bound`; distances are parts of it (with a single
    bound: of the starting value's distance from it). They are those of logarithms where the scale of training is,
    unless the bound is the one next to zero: effects are proportional to the constant there."""

    scale: Bijection
    value: float
    bound: float

    @property
    def _logarithmic(self) -> bool:
        return self.scale.logarithmic and abs(self.bound) == max(abs(self.scale.low), abs(self.scale.high))

    @property
    def _unit(self) -> float:
        scale = self.scale
        if self._logarithmic:
            return scale.width
        return scale.high - scale.low if scale.two_sided else scale.unit(self.bound)

    def places(self, step: float, direction: float) -> Places:
        """Places in a direction, with a `step` as their unit (not finite: not known)."""
        stride = direction * (min(step, WIDE) if math.isfinite(step) and step > 0 else WIDE)
        scale, end = self.scale, self.scale.high if direction > 0 else self.scale.low
        least = min(LEAST, *(0.1 * scale.distance(self.value, bound) for bound in (scale.low, scale.high)))

        def entry(place: float) -> float:
            return self._entry(scale.inside(self._moved(place * stride), least))

        return Places(entry, self._distance(end) / abs(stride))

    def part(self, entry: float, deviation: float) -> float:
        """The standard deviation of an entry as a part of the range."""
        maps, u = Bijections((self.scale,)), np.array([entry])
        sd = deviation * abs(float(maps.derivative(u)[0]))
        size = abs(float(maps.to_natural(torch.from_numpy(u))[0])) if self._logarithmic else 1.0
        return sd / size / abs(self._unit)

    def near(self, inside: Callable[[float], bool]) -> float:
        """A distance at which an entry is `inside` of the interval although nothing else changes: the interval ends
        further away."""
        away, distance = (1.0 if self.bound == self.scale.low else -1.0), WIDE
        for _ in range(TRIALS):
            if inside(self._entry(self._moved(away * distance))):
                break
            distance /= CLOSER
        return distance

    def _moved(self, part: float) -> float:
        return self.value * math.exp(self._unit * part) if self._logarithmic else self.value + self._unit * part

    def _distance(self, end: float) -> float:
        if math.isinf(end):
            return math.inf
        return abs((math.log(end / self.value) if self._logarithmic else end - self.value) / self._unit)

    def _entry(self, value: float) -> float:
        return float(Bijections((self.scale,)).from_natural(np.array([value]))[0])
