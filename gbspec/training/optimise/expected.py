"""Standard deviations at the end of a fit to innovations: from the inverse of the expected information."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.training.engines import Filtered, FilterEngine, filter
from gbspec.training.optimise.certainty import Certainty
from gbspec.training.optimise.held import tied_at_bounds
from gbspec.training.optimise.restricted import FLAT, inverse
from gbspec.training.problem import Integers

ROUNDING = 1e-13
"""The smallest information of a combination of entries, over the largest, that is more than rounding."""


def certainty_of(engine: FilterEngine, vector: Array, found: Filtered, matrix: Array, gradient: Array) -> Certainty:
    """Standard deviations and correlations of constants from the inverse of the information `matrix` at a vector [size]
    with its filter `found`; unknown (NaN) for a constant on which the data say nothing, such as a diffusion that has
    gone to zero. What ended at a bound is held there: it keeps the deviation by which that is seen, and no other
    depends on it."""
    parameters = engine.parameters
    if not found.finite:
        return Certainty.unknown(parameters)
    matrix = filter.without_followed(engine, vector, found, matrix)
    covariance = inverse(matrix, engine.layout.free, ROUNDING)
    ended = engine.ended(vector, _roots(covariance))
    gone = np.flatnonzero(ended[parameters.size :]) + parameters.size
    held = np.flatnonzero(ended[: parameters.size])
    free = _roots(_with_held(engine, matrix, gone))
    covariance = _with_held(engine, matrix, np.concatenate([held, gone]))
    maps, n = parameters.bijections(parameters.shared), parameters.n_weights
    widths = maps.lengths(vector[n : parameters.n_shared])[held - n]
    tied = tied_at_bounds(matrix, gradient, covariance, free, held, widths)
    covariance[held, held] = free[held] ** 2
    known = np.diag(matrix) > 10 * FLAT
    places = np.arange(n, parameters.n_shared)
    slopes, sd = maps.derivative(vector[places]), _roots(covariance)
    roots = np.maximum(sd[places], 1e-300) * np.where(slopes < 0, -1.0, 1.0)
    correlations = covariance[np.ix_(places, places)] / np.outer(roots, roots)
    deviations = np.where(known[places], np.abs(slopes) * sd[places], np.nan)
    freedom = float(np.sum(known & (engine.layout.free > 0)))
    own = _own(engine, vector, sd, known)
    return Certainty(deviations, correlations, freedom, own, tied[places] if len(held) else np.zeros(0))


def _own(engine: FilterEngine, vector: Array, sd: Array, known: Mask) -> Array:
    """The standard deviations [N, j] of the constants per trajectory, from those of the entries `sd` [size]."""
    parameters = engine.parameters
    if not parameters.own:
        return np.zeros((parameters.trajectories, 0))
    local = vector[parameters.n_shared : parameters.size].reshape(-1, parameters.n_local)[:, : len(parameters.own)]
    begin = parameters.n_shared + np.arange(parameters.trajectories)[:, None] * parameters.n_local
    at = begin + np.arange(len(parameters.own))
    slopes = np.abs(parameters.bijections(parameters.own).derivative(local.copy()))
    return np.where(known[at], slopes * sd[at], np.nan)


def _with_held(engine: FilterEngine, matrix: Array, entries: Integers) -> Array:
    """The inverse of a matrix with these entries held."""
    moving = engine.layout.free.copy()
    moving[entries] = 0.0
    return inverse(matrix, moving, ROUNDING)


def _roots(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)), dtype=np.float64)
