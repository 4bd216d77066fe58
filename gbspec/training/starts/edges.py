"""Minima at which the sum of squares jumps.

The time of an event that sets a measured quantity, or the lag of a dose into a measured state: where it passes a row,
that row's prediction jumps. Between two rows the sum of squares is smooth, and it may fall all the way to the jump: a
search rests there in each of these pieces, however often it begins, and no derivative leads from one to the next.
"""

from __future__ import annotations

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.ir import may_jump
from gbspec.training.engines import Engine, residual_vector
from gbspec.training.problem import mean_loss

NEAR = 1e-6
"""The distance of a jump, as a part of a constant's value."""
JUMP, MOVED = 1e-3, 1e-2
"""The sum of squares jumps where it changes by more than this part over that distance, and a residual by so many
standard deviations of its channel: the sum of squares of exact data changes by any part of itself."""


def at_jumps(engine: Engine, theta: Array) -> list[int]:
    """The shared constants, by their places among these, at which the sum of squares jumps just beside a vector."""
    parameters, found = engine.parameters, list[int]()
    if not may_jump(engine.problem.model):
        return []
    scale = parameters.bijections(parameters.shared)
    natural = scale.to_natural(torch.from_numpy(theta[parameters.places])).numpy()
    here = residual_vector(engine, theta)
    loss = mean_loss(here)
    for i, value in enumerate(natural):
        for sign in (-1, 1):
            moved, vector = natural.copy(), theta.copy()
            moved[i] += sign * NEAR * (abs(value) or 1.0)
            vector[parameters.places] = scale.from_natural(moved)
            there = residual_vector(engine, vector)
            if np.abs(there - here).max(initial=0.0) > MOVED and abs(mean_loss(there) - loss) > JUMP * loss:
                found.append(i)
                break
    return found
