"""A maximum with disturbances near none, from the other constants of a fit that has come to rest with larger ones.

A likelihood may have several maxima by the sizes of disturbances. From a start that is too large it comes to rest where
disturbances explain what the balances should: constants then follow from next to nothing. So where a fit rests, the
other constants are fitted with next to no disturbances, of which the best of several sizes is then gone on with.
"""

from __future__ import annotations

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines import FilterEngine
from gbspec.training.optimise.maximum import Likeliest, likeliest
from gbspec.training.optimise.restricted import sizes
from gbspec.training.problem import Integers

NONE = (1e-6, 1e-4, 1e-2)
"""The parts of sizes with which the other constants are fitted as without disturbances: the first one with which there
is a solution."""
LARGER = tuple(10.0 ** (0.5 * k) for k in range(1, 12))
"""The factors by which sizes then grow, of which the best one is gone on with."""
HIGHER = 0.5
"""The log likelihood of a maximum that is taken is higher by more: 1 of -2 log likelihood."""


def near_none(engine: FilterEngine, vector: Array) -> Array | None:
    """A vector [size] near a higher maximum of the likelihood than that near `vector`, with smaller disturbances; None
    if none was found, and for models with networks or without learned sizes."""
    entries = _learned(engine)
    if engine.parameters.n_weights or not len(entries):
        return None
    start = undisturbed(engine, vector)
    if start is None or not (first := likeliest(engine, start)).found.finite:
        return None
    found = [first]
    grown = [_scaled(engine, found[0].vector, entries, factor) for factor in LARGER]
    values = [engine.value(each) for each in grown]
    best = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    if values[best] < found[0].found.value:
        found.append(likeliest(engine, grown[best]))
    highest = min(found, key=lambda one: one.compared)
    return highest.vector if higher(engine, highest, vector) else None


def higher(engine: FilterEngine, one: Likeliest, vector: Array) -> bool:
    """Whether a maximum is higher than that near a vector, by more than `HIGHER`."""
    return one.compared < likeliest(engine, vector).compared - HIGHER


def undisturbed(engine: FilterEngine, vector: Array) -> Array | None:
    """The vector [size] with next to no disturbances, and learned noises no smaller than those a fit begins with: where
    disturbances explain all, these have gone to nothing. None if there is no solution, or no learned size."""
    entries, size = _learned(engine), engine.parameters.size
    for part in NONE if len(entries) else ():
        start = _scaled(engine, vector, entries, part)
        start[size:] = np.maximum(start[size:], engine.noise.first())
        if np.isfinite(engine.value(start)):
            return start
    return None


def _learned(engine: FilterEngine) -> Integers:
    """The entries that are learned sizes of disturbances."""
    found = sizes(engine)
    return found[(found < engine.parameters.size) & (engine.layout.free[found] > 0)]


def _scaled(engine: FilterEngine, vector: Array, entries: Integers, factor: float) -> Array:
    """The vector with the sizes at `entries` multiplied by a factor, inside of their bounds."""
    parameters, out = engine.parameters, vector.copy()
    maps = parameters.bijections(tuple(parameters.shared[i - parameters.n_weights] for i in entries))
    natural = maps.to_natural(torch.from_numpy(vector[entries])).numpy()
    out[entries] = maps.inside(maps.from_natural(factor * natural))
    return out


__all__ = ["higher", "near_none", "undisturbed"]
