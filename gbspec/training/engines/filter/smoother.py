"""Smoothed moments: what all measurements say of a state, later ones included (Rauch, Tung and Striebel 1965)."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.legs import Legs
from gbspec.training.engines.filter.result import Filtered

RANK = 1e-12
"""Directions with less than this share of the largest variance have none."""


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
