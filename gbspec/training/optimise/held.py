"""Constants of likelihoods that ended at bounds: the others have the covariance of a fit in which these are held.

At a bound the scale of training ends: the information of a constant there goes to nothing, and in the inverse of the
whole matrix it lends the others any standard deviation. Held, it lends none; whether the data tie another constant to
it shows in how far that one would move with it while the likelihood allows it to leave the bound.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.runs import NORMAL_90
from gbspec.training.problem import Integers

FALL = NORMAL_90**2
"""-2 log likelihood may rise by this within a 90 % interval."""


def tied_at_bounds(
    matrix: Array, gradient: Array, covariance: Array, free: Array, held: Integers, most: Array
) -> Array:
    """How many times as large standard deviations [size] would be with the entries `held` free, where the data tie
    entries to these; 1 for all others, NaN for those held.

    `matrix` and `gradient` are of the negative log likelihood, `covariance` its inverse with the entries held, `free`
    the deviations without that; `most`: how far each of those held can move on its scale, straight from where it is.
    An entry is tied if it leaves its 90 % interval as one of them moves inside, everything else refitted, as far as the
    likelihood allows: by d with g d + s d^2/2 = FALL/2, g being the gradient and s what the others leave of the
    information.
    """
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    out = np.ones(len(matrix))
    with np.errstate(invalid="ignore", divide="ignore"):
        factors = free / deviations
        for place, limit in zip(held, most, strict=True):
            along = -covariance @ matrix[:, place]
            left = max(float(matrix[place, place] + matrix[place] @ along), 0.0)
            slope = abs(float(gradient[place]))
            move = min(FALL / max(slope + np.sqrt(slope**2 + left * FALL), 1e-300), limit)
            out = np.where(np.abs(move * along) > NORMAL_90 * deviations, factors, out)
    out[held] = np.nan
    return out
