"""Constants that a fit has left at a bound although what it minimises falls inwards.

The scale of training has a bound at infinity, and its slope there goes to nothing: a step that was too long takes a
constant so near to its bound that no later one moves it, whatever that costs. So where a fit rests, constants at bounds
are tried inside, and the fit goes on from there if it is better.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from gbspec.arrays import Array
from gbspec.training.problem import Bijections

NEAR = 1e-5
"""A constant is tried inside that is closer to its bound than this fraction of its range."""
WAY = (1e-4, 1e-3, 0.01, 0.03, 0.1, 0.3)
"""The fractions of the range, on its scale, by which it is tried inside, until that is worse than the last one."""


def released(maps: Bijections, u: Array, value: Callable[[Array], float], least: float) -> Array | None:
    """The trainable values `u` [k] of constants, with those inside of their bounds by which the objective `value(u)`,
    all else held, is lower by more than `least`; None if there are none."""
    best, lowest, found = u, None, False
    natural = maps.to_natural(torch.from_numpy(u)).numpy()
    for i, one in enumerate(maps.each):
        bounds = [b for b in (one.low, one.high) if one.low < one.high and one.distance(natural[i], b) < NEAR]
        if not bounds:
            continue
        lowest = value(best) if lowest is None else lowest
        before, last = best, lowest
        for share in WAY:
            moved = natural.copy()
            moved[i] = one.inside(float(natural[i]), share)
            trial = before.copy()
            trial[i] = maps.from_natural(moved)[i]
            there = value(trial)
            if not there < last:
                break
            last = there
            if there < lowest - least:
                best, lowest, found = trial, there, True
    return best if found else None


__all__ = ["released"]
