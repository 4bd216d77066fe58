"""A maximum inside of the bounds at which a fit has come to rest, from other values of its constants there.

At a bound, and where the likelihood does not change with a constant, its slope says nothing of what lies further in: a
rate may have gone to its upper bound, as where only the variance is left to explain, although a slow one explains the
data better. Nor can sizes of disturbances alone show that: at such a rate there is nothing for them to give way to. So
where constants rest like that, the fit is tried from values between their bounds, each with the sizes of the
disturbances as they are and with next to none.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise.maximum import information_with_priors, likeliest
from gbspec.training.optimise.near_none import higher, undisturbed
from gbspec.training.optimise.restricted import LEAST, inverse, sizes
from gbspec.training.problem import Bijection, Bijections, Integers

SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""The places between two bounds that are tried, as shares of the range on its scale."""
PARTS = (0.001, 0.01, 0.1, 0.3, 0.9)
"""The same of a range that ends at zero and is not one of logarithms, from there."""
FACTORS = (0.01, 0.1, 10.0, 100.0)
"""With one bound: distances from it, in units of that of the starting value."""
MOST = 2
"""So many constants are tried inside at most, one after the other."""
SHORT, BEST = 6, 4
"""Steps of each trial, and how many of them, the best ones, are gone on with."""
UNKNOWN = 1.0
"""The likelihood hardly changes with a constant whose trainable value has a larger standard deviation: a unit of it is
about a factor of e^3, or most of the range."""


def inner(engine: FilterEngine, vector: Array) -> Array | None:
    """A vector [size] at a higher maximum of the likelihood than that near `vector`, where constants lie inside that
    are at bounds in `vector`, or with which nothing changes there; None if none was found, and for models with
    networks."""
    places = _stuck(engine, vector)
    if not len(places):
        return None
    declared, *others = _moved(engine, vector, places)
    undisturbed_ones = (undisturbed(engine, start) for start in (declared, *others))
    starts = [declared, *(start for start in undisturbed_ones if start is not None)]
    short = sorted((likeliest(engine, start, steps=SHORT) for start in starts), key=lambda one: one.compared)
    highest = min((likeliest(engine, one.vector) for one in short[:BEST]), key=lambda one: one.compared)
    return highest.vector if higher(engine, highest, vector) else None


def _stuck(engine: FilterEngine, vector: Array) -> Integers:
    """The entries of constants, shared by all trajectories and no sizes of disturbances, that are at a bound or with
    which the likelihood hardly changes, the least known first."""
    parameters = engine.parameters
    if parameters.n_weights:
        return np.zeros(0, dtype=np.int64)
    places = np.setdiff1d(np.arange(parameters.n_shared), sizes(engine))
    places = places[engine.layout.free[places] > 0]
    matrix = information_with_priors(engine, vector)
    with np.errstate(divide="ignore"):  # the inverse is zero where there is no information at all
        each, together = 1 / np.diag(matrix), np.diag(inverse(matrix, engine.layout.free, LEAST))
    deviations = np.sqrt(np.maximum(each, together))[places]
    unknown = np.full(parameters.n_shared, np.nan)
    at_bounds = _maps(engine).ended(vector[: parameters.n_shared], unknown)[places]
    order = np.argsort(-deviations, kind="stable")
    chosen: Integers = places[order][(at_bounds | (deviations > UNKNOWN))[order]].astype(np.int64)
    return chosen[:MOST]


def _moved(engine: FilterEngine, vector: Array, places: Integers) -> list[Array]:
    """The vector with each of these entries at each of its places inside, and with all of them where they start."""
    maps, size = _maps(engine), engine.parameters.n_shared
    natural = maps.to_natural(torch.from_numpy(vector[:size])).numpy()

    def at(values: Array, entries: Integers) -> Array:
        out = vector.copy()
        out[entries] = maps.inside(maps.from_natural(values))[entries]
        return out

    declared = np.array([one.start for one in maps.each])
    out = [at(declared, places)]
    for place in places:
        for value in _places(maps.each[place]):
            values = natural.copy()
            values[place] = value
            out.append(at(values, places[places == place]))
    return out


def _places(one: Bijection) -> list[float]:
    """The values of a constant that are tried."""
    if one.two_sided:
        if one.logarithmic:
            return [one.low * math.exp(one.width * share) for share in SHARES]
        if one.low == 0 or one.high == 0:
            return [(one.low + one.high) * part for part in PARTS]
        return [one.low + one.width * share for share in SHARES]
    if math.isinf(one.low) and math.isinf(one.high):
        return []
    bound, side = (one.low, 1.0) if math.isfinite(one.low) else (one.high, -1.0)
    return [bound + side * factor * one.unit(bound) for factor in FACTORS]


def _maps(engine: FilterEngine) -> Bijections:
    return engine.parameters.bijections(engine.parameters.shared)


__all__ = ["inner"]
