"""Smooth maps from the real line to a constant's allowed range, so that bounds hold by construction.

The optimiser works with `u`, and the constant is the map at `STRETCH * u`: a unit step of `u` is about a factor of e^3,
because constants are few and their starting values are more often far off than those of weights.

- Two-sided bounds use the logistic function: on the scale of logarithms if both bounds have the same sign and are far
  apart (`Range.logarithmic`), since such a range says that the order of magnitude is unknown, else linearly.
- One-sided bounds use the exponential function of the distance from the bound.
- Without bounds the map is the identity, scaled by the starting value.
- A constant that *starts* on its bound would have no derivative there, since all of these reach a bound at infinite `u`
  only. Its map touches the bound at a finite `u` instead and turns back: sin^2 with two bounds, cosh - 1 with one.

Starting values are kept as they are, up to rounding; those on a bound are off it by `EDGE` of the range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.ir import Learnable, Range

STRETCH = 3.0
EDGE = 1e-12
"""Distance from the bound, as a fraction of the range, at which a constant begins whose starting value is on the bound:
the derivative of its map is about the root of this."""
ROUNDING = 1e-16
"""Least distance from a bound, as a fraction of the range, in the inverse of a map that reaches the bound at infinity:
final values may have been rounded to their bound."""
LEAST = 1e-30
"""The same with a single bound, as a fraction of the starting value."""
NEAR, CLEAR = 1e-5, 5.0
"""A constant closer to a bound than the fraction `NEAR` of its range is at the bound, unless it is `CLEAR` standard
deviations away from it."""
BESIDE, NARROW = 1 / 3, 0.1
"""So is one that is closer to it than `BESIDE` of its standard deviation, where that is below `NARROW` of the bounds'
width (a larger one is that of a constant which the data do not show). The scale of training ends at a bound: its slope
tells nothing of the ends of an interval that are several times as far off as the bound."""
CLOSE = 1e-3
"""Closer to a bound than this fraction of its range, a constant is there with any larger standard deviation too: that
is of the end of the scale, where nothing changes any more, and fits stop on the way."""
FAR, FELT = 1 / 30, 1 / 3
"""Closer to a bound than `FAR` of its standard deviation, a constant is there also where this is below `FELT` of the
bounds' width: such data tell it from the other bound, which an interval on the scale of training would reach."""
INSIDE = 1e-6
"""Slopes in natural units of a constant at a bound are those so far inside, as a part of the range."""
ALIKE = 1e-6
"""An end of an interval cannot be told from a bound if it is closer to it than this fraction of the value is."""


@dataclass(frozen=True)
class Bijection:
    """The map of one constant."""

    low: float
    high: float
    start: float

    @classmethod
    def of(cls, learnable: Learnable) -> Bijection:
        """The map for a constant's bounds and starting value."""
        return cls(learnable.range.low, learnable.range.high, learnable.start)

    @cached_property
    def scale(self) -> float:
        """The unit of values without two bounds."""
        return abs(self.start) if self.start != 0 else 1.0

    @cached_property
    def reflecting(self) -> bool:
        """Whether the starting value is on a bound, so that the map must reach it."""
        if self.two_sided:
            return min(self.distance(self.start, bound) for bound in (self.low, self.high)) <= EDGE
        return self.start in (self.low, self.high)

    @cached_property
    def two_sided(self) -> bool:
        """Whether there are two bounds."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    @cached_property
    def logarithmic(self) -> bool:
        """Whether logarithms of the (two, far apart) bounds are used."""
        return Range(self.low, self.high).logarithmic

    @cached_property
    def width(self) -> float:
        """The width of a two-sided range on its scale."""
        return math.log(self.high / self.low) if self.logarithmic else self.high - self.low

    def distance(self, value: float, bound: float) -> float:
        """The distance of a value from a bound as a fraction of the range on its scale, or of the starting value's
        distance from a single bound; infinite without a bound there."""
        if math.isinf(bound):
            return math.inf
        if self.two_sided:
            inside = np.array(value)
            return float(self._fraction(inside) if bound == self.low else self._rest(inside))
        return abs(value - bound) / self.unit(bound)

    def share(self, value: float, sd: float | None) -> float:
        """A standard deviation as a part of the width of two bounds, on their scale; NaN if it is not known."""
        if sd is None or not self.two_sided:
            return math.nan
        natural = abs(value) if self.logarithmic else 1.0
        return sd / natural / abs(self.width) if natural else math.nan

    def ended_at(self, value: float, sd: float = math.nan) -> float | None:
        """The bound that stopped a constant with this value and standard deviation (see `NEAR`, `BESIDE`, `CLOSE`,
        `FAR`); None if neither did.

        With a single bound, the distance of the starting value from it is used as the width.
        """
        for bound in (self.low, self.high) if self.low < self.high else ():
            distance, width = self.distance(value, bound), self.share(value, sd)
            # A deviation of zero says that the map is flat there, not that the constant is known.
            near = distance < NEAR and not (sd > 0 and abs(value - bound) > CLEAR * sd)
            beside = distance < BESIDE * width and (width < NARROW or distance < CLOSE)
            if near or beside or (distance < FAR * width and width < FELT):
                return bound
        return None

    def end(self, end: float, value: float) -> float:
        """An end of the interval of a value, as it is told: one that two bounds hold back is the bound. What is left of
        the map there is the error of rounding, or an underflow."""
        for bound in (self.low, self.high) if self.two_sided and self.low < self.high else ():
            if self.distance(end, bound) <= ALIKE * self.distance(value, bound):
                return bound
        return end

    def inside(self, value: float, share: float) -> float:
        """The value, or what lies within the bounds by this share of the range on its scale (with a single bound: of
        the starting value's distance from it)."""
        if self.logarithmic:
            place = np.log(np.clip(value, self.low, self.high) / self.low)
            return self.low * float(np.exp(self.width * self._clipped(place, share)))
        if self.two_sided:
            return self.low + self.width * self._clipped(np.array(value - self.low), share)
        if math.isinf(self.low) and math.isinf(self.high):
            return value
        bound = self.low if math.isfinite(self.low) else self.high
        least = share * self.unit(bound)
        return max(value, bound + least) if bound == self.low else min(value, bound - least)

    def unit(self, bound: float) -> float:
        """The distance of the starting value from a single bound, in which distances from it are counted."""
        return abs(self.start - bound) or self.scale

    def _clipped(self, place: Array, share: float) -> float:
        return float(np.clip(place / self.width, share, 1 - share))

    # ---------------------------------------------------------------- natural values from raw ones
    @property
    def kind(self) -> tuple[bool, ...]:
        """What decides by which formula the constant follows from its raw value."""
        return math.isfinite(self.low), math.isfinite(self.high), self.logarithmic, self.reflecting

    # ---------------------------------------------------------------- raw values from natural ones
    def raw(self, value: Array) -> Array:
        """The raw values of natural ones; values on or beyond a bound are moved inside."""
        if self.two_sided:
            least = EDGE if self.reflecting else ROUNDING
            fraction, rest = np.maximum(self._fraction(value), least), np.maximum(self._rest(value), least)
            inner = 4 * np.arctan2(np.sqrt(fraction), np.sqrt(rest)) if self.reflecting else np.log(fraction / rest)
            return np.asarray(inner * (abs(self.width) / 4 if self.logarithmic else 1.0), dtype=np.float64)
        if math.isinf(self.low) and math.isinf(self.high):
            return np.asarray(value / self.scale, dtype=np.float64)
        beyond = (value - self.low if math.isfinite(self.low) else self.high - value) / self.scale
        if self.reflecting:
            return np.asarray(2 * np.arcsinh(np.sqrt(0.5 * np.maximum(beyond, EDGE))), dtype=np.float64)
        return np.asarray(np.log(np.maximum(beyond, LEAST)), dtype=np.float64)

    def _fraction(self, value: Array) -> Array:
        """The distance from the lower bound, as a fraction of the range on its scale."""
        if self.logarithmic:
            inside = np.clip(value, self.low, self.high)
            return np.asarray(np.log(inside / self.low) / self.width, dtype=np.float64)
        return np.asarray((value - self.low) / self.width, dtype=np.float64)

    def _rest(self, value: Array) -> Array:
        """The distance from the upper bound, computed without loss of digits near it."""
        if self.logarithmic:
            inside = np.clip(value, self.low, self.high)
            return np.asarray(np.log(self.high / inside) / self.width, dtype=np.float64)
        return np.asarray((self.high - value) / self.width, dtype=np.float64)


class _Alike:
    """Maps by one formula, evaluated together: `indices` [k] among the constants, and their numbers [k]."""

    def __init__(self, indices: list[int], each: list[Bijection]) -> None:
        self.indices, self.one = indices, each[0]
        numbers = np.array([(one.low, one.high, one.width, one.scale) for one in each])
        self.numbers = torch.from_numpy(numbers.T.copy())

    def natural(self, raw: Tensor) -> Tensor:
        """The constants' values [..., k] at raw ones [..., k]."""
        low, high, width, scale = self.numbers.to(raw).unbind()
        above, below, logarithmic, reflecting = self.one.kind
        if above and below:
            # The slope in the middle of the range is that of the logistic function, or 1 on a scale of logarithms: as
            # with a single bound, one unit is then a factor of e.
            inner = raw * (4 / width.abs()) if logarithmic else raw
            fraction = torch.sin(0.25 * inner) ** 2 if reflecting else torch.sigmoid(inner)
            value = low * torch.exp(width * fraction) if logarithmic else low + width * fraction
            return torch.clamp(value, low, high)
        if not above and not below:
            return scale * raw
        # cosh(x) - 1, without its loss of digits near 0
        beyond = 2 * torch.sinh(0.5 * raw) ** 2 if reflecting else torch.exp(raw)
        return low + scale * beyond if above else high - scale * beyond


@dataclass(frozen=True)
class Bijections:
    """One map per learnable, evaluated together."""

    each: tuple[Bijection, ...]

    @staticmethod
    def of(learnables: tuple[Learnable, ...]) -> Bijections:
        """The maps of a model's learnables."""
        return _together(tuple(map(Bijection.of, learnables)))

    @cached_property
    def _scales(self) -> Array | None:
        """The units of natural values [n], if none has a bound: then the maps are linear."""
        bounded = any(math.isfinite(one.low) or math.isfinite(one.high) for one in self.each)
        return None if bounded or not self.each else np.array([one.scale for one in self.each])

    def to_natural(self, u: Tensor) -> Tensor:
        """Natural values [..., n] of trainable values `u` [..., n]."""
        raw = STRETCH * u
        if self._scales is not None:
            return raw * raw.new_tensor(self._scales)
        if len(self._groups) < 2:
            return self._groups[0].natural(raw) if self._groups else u
        parts = [group.natural(raw[..., group.indices]) for group in self._groups]
        return torch.cat(parts, -1)[..., self._order]

    @cached_property
    def _groups(self) -> list[_Alike]:
        """The maps by formula: every solution needs the constants, and a call for each would take most of its time."""
        kinds: dict[tuple[bool, ...], list[int]] = {}
        for i, one in enumerate(self.each):
            kinds.setdefault(one.kind, []).append(i)
        return [_Alike(indices, [self.each[i] for i in indices]) for indices in kinds.values()]

    @cached_property
    def _order(self) -> list[int]:
        """The place of each constant among those of all groups."""
        return [int(i) for i in np.argsort([i for group in self._groups for i in group.indices])]

    def derivative(self, u: Array) -> Array:
        """d natural / d u, elementwise."""
        if self._scales is not None:
            return np.broadcast_to(STRETCH * self._scales, np.shape(u)).copy()
        x = torch.tensor(u, dtype=torch.float64, requires_grad=True)
        if x.shape[-1] == 0:
            return np.zeros_like(u)
        (slope,) = torch.autograd.grad(self.to_natural(x).sum(), x)
        return np.asarray(slope.numpy(), dtype=np.float64)

    def inside(self, u: Array) -> Array:
        """The trainable values [n] with those moved at which the map is flat, as at a bound that it reaches: by
        `INSIDE` of the range (of the starting value's size with a single bound), where slopes are known."""
        flat = np.flatnonzero(self.derivative(u) == 0)
        natural, out = self.to_natural(torch.from_numpy(u)).numpy().copy(), np.array(u, dtype=np.float64)
        for i in flat:
            one = self.each[i]
            size = INSIDE * (one.high - one.low if one.two_sided else one.scale)
            natural[i] += size if abs(natural[i] - one.low) <= abs(one.high - natural[i]) else -size
        out[flat] = self.from_natural(natural)[flat]
        return out

    def ended(self, u: Array, deviations: Array) -> Mask:
        """Which constants [n] with these trainable values, and standard deviations of them, ended at a bound."""
        values = self.to_natural(torch.from_numpy(u)).numpy()
        sd = np.abs(self.derivative(u)) * deviations
        each = zip(self.each, values.tolist(), sd.tolist(), strict=True)
        return np.array([one.ended_at(value, size) is not None for one, value, size in each], dtype=np.bool_)

    def lengths(self, u: Array) -> Array:
        """The widths [n] between two bounds in units of trainable values, by the slopes at these values; infinite with
        fewer bounds."""
        width = np.array([one.high - one.low for one in self.each])
        return np.asarray(width / np.maximum(np.abs(self.derivative(u)), 1e-300), dtype=np.float64)

    def from_natural(self, value: Array) -> Array:
        """Trainable values of natural ones [..., n]; values on or beyond a bound are moved inside."""
        out = np.empty_like(value, dtype=np.float64)
        for i, one in enumerate(self.each):
            out[..., i] = one.raw(value[..., i]) / STRETCH
        return out


@lru_cache(maxsize=64)
def _together(each: tuple[Bijection, ...]) -> Bijections:
    """The same maps are asked for in every step of a warm start."""
    return Bijections(each)
