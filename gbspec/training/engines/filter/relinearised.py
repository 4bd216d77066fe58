"""Smoothed moments of nonlinear models, linearised where the smoothed moments are.

Where nothing is measured for long, the filter's moments are far from where the later measurements show the states to
have been, and so is its linearisation. `iterated` linearises again at the smoothed moments until these are what they
lead to (Garcia-Fernandez, Svensson, Sarkka 2017, IEEE Trans. Signal Process. 65, 1: iterated posterior linearisation).
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.engine import FilterEngine
from gbspec.training.engines.filter.result import Filtered, Guess
from gbspec.training.engines.filter.smoother import smoothed

ITERATIONS, CLOSE = 30, 1e-4
"""The most iterations, and the movement in typical sizes of the states below which the path rests."""


def iterated(engine: FilterEngine, vector: Array, found: Filtered) -> tuple[Array, Array, Array, Array]:
    """Smoothed moments as `smoothed` returns them, of the filter linearised at the smoothed means; those of the filter
    itself where the iteration does not come to rest."""
    plain = moments = smoothed(found, engine.legs)
    if not found.finite or engine.affine:
        return plain
    at, last = _guess(moments, found.shares), np.inf
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
        new = _guess(moments, found.shares)
        a, b, c, d = (share * one + (1 - share) * old for one, old in zip(new[:4], at[:4], strict=True))
        at = a, b, c, d, found.shares
        last = change
    return plain


def _guess(moments: tuple[Array, Array, Array, Array], shares: Array) -> Guess:
    """Moments at ends and starts, those at starts first, with the steps of legs."""
    mean, cov, start_mean, start_cov = moments
    return start_mean, start_cov, mean, cov, shares
