"""Smoothed moments of nonlinear models, linearised where the smoothed means are.

Where nothing is measured for long, the filter's means are far from where the later measurements show the states to have
been, and so is its linearisation. `iterated` linearises again at the smoothed means until these are what they lead to:
then they are the most probable path (Bell 1994, SIAM J. Optim. 4, 626: Gauss-Newton steps).
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.engine import FilterEngine
from gbspec.training.engines.filter.result import Filtered
from gbspec.training.engines.filter.smoother import smoothed

ITERATIONS, CLOSE = 30, 1e-4
"""The most iterations, and the movement in typical sizes of the states below which the path rests."""


def iterated(engine: FilterEngine, vector: Array, found: Filtered) -> tuple[Array, Array, Array, Array]:
    """Smoothed moments as `smoothed` returns them, of the filter linearised at the smoothed means; those of the filter
    itself where the iteration does not come to rest."""
    plain = moments = smoothed(found, engine.legs)
    if not found.finite or engine.affine:
        return plain
    at, last = (moments[2], moments[0]), np.inf
    for _ in range(ITERATIONS):
        again = engine.linearised(vector, at, found.seen)
        if again.bad.any() or not np.isfinite(again.post_mean).all():
            return plain
        before, moments = moments, smoothed(again, engine.legs)
        change = float(np.max(np.abs(moments[0] - before[0]) / engine.scale, initial=0.0))
        if not np.isfinite(change):
            return plain
        if change < CLOSE:
            return moments
        # Paths that swing from side to side are averaged.
        share = 1.0 if change < 0.5 * last else 0.5
        at = share * moments[2] + (1 - share) * at[0], share * moments[0] + (1 - share) * at[1]
        last = change
    return plain
