"""Evenly distributed positions in a list and quasirandom points of a box.

The points are those of the additive recurrence with the generalised golden ratio:

x_i = (1/2 + i/g, 1/2 + i/g^2, ...) modulo 1, with g the root of g^(d+1) = g + 1 (Roberts 2018, "The unreasonable
effectiveness of quasirandom sequences"): low discrepancy in few dimensions, also of every initial part of the sequence.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array


def evenly_spaced(count: int, most: int) -> list[int]:
    """All of `count` positions, or `most` of them, evenly spaced from the first to the last."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))] if count else []


def quasirandom_points(count: int, size: int, seed: int = 0) -> Array:
    """`count` points [count, size] of the unit cube; the seed shifts the sequence."""
    if size == 0:
        return np.zeros((count, 0))
    g = 2.0
    for _ in range(60):
        g = (1.0 + g) ** (1.0 / (size + 1))
    steps = g ** -np.arange(1.0, size + 1.0)
    index = np.arange(1 + 1009 * seed, 1 + 1009 * seed + count)
    return np.asarray((0.5 + index[:, None] * steps) % 1.0)
