"""Smoothed moments: what all measurements say of a state, later ones included (Rauch, Tung and Striebel 1965).

Where nothing is measured for long, the filter's means are far from where the later measurements show the states to have
been, and so is its linearisation. `iterated` linearises again at the smoothed means until these are what they lead to:
then they are the most probable path (Bell 1994, SIAM J. Optim. 4, 626: Gauss-Newton steps).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.legs import Legs
from gbspec.training.engines.filter.result import Filtered

if TYPE_CHECKING:
    from gbspec.training.engines.filter.engine import FilterEngine

RANK = 1e-12
"""Directions with less than this share of the largest variance have none."""
ITERATIONS, CLOSE = 30, 1e-4
"""The most iterations, and the movement in typical sizes of the states below which the path rests."""


def smoothed(found: Filtered, legs: Legs) -> tuple[Array, Array, Array, Array]:
    """Means [B, n] and covariances [B, n, n] at the ends of all legs, and those at their starts."""
    mean, cov = found.post_mean.copy(), found.post_cov.copy()
    start_mean, start_cov = found.start_mean.copy(), found.start_cov.copy()
    for place in range(legs.places - 1, -1, -1):
        span = legs.at(place)
        # Trajectories with a later leg have smoothed moments at this leg's end, which are those at that leg's start.
        if place + 1 < legs.places:
            following = legs.at(place + 1)
            count = following.stop - following.start
            part = slice(span.start, span.start + count)
            mean[part], cov[part] = start_mean[following], start_cov[following]
        before, after = found.start_cov[span], found.end_cov[span]
        cross = np.matmul(before, found.a[span].transpose(0, 2, 1))
        gain = np.matmul(cross, np.linalg.pinv(after, rcond=RANK, hermitian=True))
        change = mean[span] - found.end_mean[span]
        start_mean[span] = found.start_mean[span] + np.matmul(gain, change[:, :, None])[:, :, 0]
        start_cov[span] = before + np.matmul(np.matmul(gain, cov[span] - after), gain.transpose(0, 2, 1))
    return mean, cov, start_mean, start_cov


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
