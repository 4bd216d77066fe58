"""How well the entries of the likelihood's vector are known, by its expected information.

A start that is learned has no variance, so that a value of its state in the first row has the variance of the noise
alone: its expected information of the logarithm of the noise is 2, as of any value that only the noise moves. But the
start follows this value, the closer the less later rows tell of it, and what is left says as little of the noise.
"""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.engines.filter.engine import FilterEngine
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.result import Filtered
from gbspec.training.problem import Integers

ALONE = 1e-6
"""The variance of a value is that of the noise alone if it is larger by at most this part."""
NOTHING = 1e-9
"""A noise of whose information less than this part is left has none."""


def deviations(engine: FilterEngine, vector: Array, found: Filtered) -> Array:
    """The standard deviations of the vector's entries, from the information; NaN where there is none. Constants at
    bounds and noises at zero are held."""
    matrix = without_followed(engine, vector, found, engine.information(vector, found).matrix)
    each = _roots(_inverse(matrix))
    held = _held(engine, matrix, vector, each)
    return np.where(held, each, _roots(_inverse(matrix))) if held.any() else each


def covariance(engine: FilterEngine, vector: Array, found: Filtered) -> Array:
    """The covariance [size, size] of the vector's entries, whose diagonal has the squares of `deviations`; 0 for what
    is held there, NaN in the diagonal where there is no information."""
    matrix = without_followed(engine, vector, found, engine.information(vector, found).matrix)
    held = _held(engine, matrix, vector, _roots(_inverse(matrix)))
    out = _inverse(matrix)
    out[held, held] = 0.0
    return out


def _held(engine: FilterEngine, matrix: Array, vector: Array, each: Array) -> Mask:
    """The entries that ended, of which an information says nothing any more: it is changed in place."""
    held = engine.ended(vector, each)
    matrix[held], matrix[:, held] = 0.0, 0.0
    return held


def without_followed(engine: FilterEngine, vector: Array, found: Filtered, matrix: Array) -> Array:
    """An information [size, size] at a vector with its filter, in which values in first rows tell of learned noises
    only what the other entries of the vector do not follow of them: with the hat matrix H of these values, a
    trajectory's information 2 tr I of a noise becomes 2 tr (I - H)^2, as that of the restricted likelihood."""
    rows, owner, noisy = _first_values(engine, vector, found)
    if not noisy.any():
        return matrix
    theta, log_sd = engine.layout.split(vector)
    at, size = At.of(engine.layout, theta), engine.parameters.size
    before = engine.start(at, True).of(owner)
    slopes = engine.readings(at, log_sd, rows, before, True).slopes(before)[0]
    covariance = np.nan_to_num(_inverse(matrix[:size, :size]))
    scale, out = np.sqrt(found.variance[rows]), matrix.copy()
    for i, who in enumerate(owner):
        places = engine.layout.places[who]
        mine = places < size
        block = covariance[np.ix_(places[mine], places[mine])]
        for place, channel in enumerate(engine.noise.learned):
            if noisy[i, channel]:
                x = slopes[i, channel, mine] / scale[i, channel]
                left = 1 - min(float(x @ block @ x), 1.0)
                out[size + place, size + place] -= 2 * (1 - left**2)
    # what is left of its information is rounding, beside which its other entries would count
    gone = size + np.flatnonzero(np.diag(out)[size:] <= NOTHING * np.diag(matrix)[size:])
    out[gone], out[:, gone] = 0.0, 0.0
    return out


def _first_values(engine: FilterEngine, vector: Array, found: Filtered) -> tuple[Integers, Integers, Mask]:
    """The rows [b] at the starts of trajectories, these trajectories, and which values there [b, C] have the variance
    of a learned noise alone."""
    legs = engine.legs
    first = np.flatnonzero((legs.place == 0) & (legs.count == 0) & (legs.row >= 0))
    rows, owner = legs.row[first], legs.owner[first]
    noise, log_sd = engine.noise, engine.layout.split(vector)[1]
    learned = (noise.column >= 0) & (noise.fixed[rows] <= 0) & found.seen[rows]
    return rows, owner, learned & (found.variance[rows] <= (1 + ALONE) * noise.variances(log_sd)[rows])


def _inverse(matrix: Array) -> Array:
    """The inverse of an information; NaN in its diagonal, and 0 beside, where there is none."""
    size = np.diag(matrix)
    scale = np.where(size > 0, 1 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)
    scaled = np.linalg.pinv(matrix * np.outer(scale, scale), rcond=1e-13, hermitian=True)
    out = np.asarray(scale[:, None] * scaled * scale, dtype=np.float64)
    np.fill_diagonal(out, np.where(size > 0, np.diag(out), np.nan))
    return out


def _roots(matrix: Array) -> Array:
    """The roots of the diagonal of a matrix; NaN where there is none."""
    return np.sqrt(np.maximum(np.diag(matrix), 0.0))
