"""When maxima of a likelihood, or minima of least squares, are equally good: which is taken, what is said of others."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gbspec.arrays import Array

SAME = 1e-3
"""Objectives of the same minimum differ by less than this, relatively."""
APART = 0.2
"""Two minima are different where a constant differs by more than this, relatively."""
ALIKE = 1.0
"""The data do not tell maxima apart whose -2 log likelihood differs by less."""
EQUALLY_WELL = "other constants fit the data equally well"
"""What a warning of them begins with."""


def indistinct(count: int) -> float:
    """The relative difference of sums of squares of `count` values that is none: of such minima the one nearest to the
    declared starting values is taken."""
    return min(SAME, 1 / count)


def unclear(count: int) -> float:
    """That by which the data do not tell two minima apart: `ALIKE` in -2 log likelihood."""
    return math.expm1(ALIKE / count)


def no_rise(count: int) -> float:
    """The difference of -2 log likelihood that `indistinct` sums of squares make."""
    return count * math.log1p(indistinct(count))


def differ(first: Array, second: Array) -> bool:
    """Whether a constant differs clearly between natural values [k]."""
    return bool((np.abs(first - second) > APART * np.maximum(np.abs(first), np.abs(second))).any())


def nearest(places: Array, declared: Array) -> int:
    """Which of the trainable values [n, k] lie nearest to the declared ones [k]."""
    return int(np.argmin(np.linalg.norm(places - declared, axis=1)))


def listed(names: Sequence[str], values: Array) -> str:
    """Constants [k] with their names, for a text."""
    return ", ".join(f"{name} {value:.3g}" for name, value in zip(names, values, strict=True))


def said_of_others(told: Sequence[tuple[str, float]], count: int) -> str:
    """A warning of other constants, each with the rise of -2 log likelihood there; empty where there are none."""
    if not told:
        return ""
    far = max(rise for _, rise in told) > no_rise(count)
    each = [f"{text} (-2 log likelihood higher by {rise:.2g})" if far else text for text, rise in told]
    taken = (
        "The best one was taken, but the data do not rule the others out, and intervals do not contain them"
        if far
        else "The one nearest to the declared starting values was taken"
    )
    return (
        f"{EQUALLY_WELL}: {'; or '.join(each)}. {taken}; narrower bounds, a prior or a starting value say which is "
        "meant"
    )
