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
    parameters, all_sizes = engine.parameters, sizes(engine)
    entries = all_sizes[(all_sizes < parameters.size) & (engine.layout.free[all_sizes] > 0)]
    if parameters.n_weights or not len(entries):
        return None
    starts = [_scaled(engine, vector, entries, part) for part in NONE]
    for start in starts:  # where disturbances explain all, learned noises have gone to nothing
        start[parameters.size :] = np.maximum(start[parameters.size :], engine.noise.first())
    finite = next((start for start in starts if np.isfinite(engine.value(start))), None)
    if finite is None or not (first := likeliest(engine, finite)).found.finite:
        return None
    found = [first]
    grown = [_scaled(engine, found[0].vector, entries, factor) for factor in LARGER]
    values = [engine.value(each) for each in grown]
    best = int(np.argmin(np.where(np.isfinite(values), values, np.inf)))
    if values[best] < found[0].found.value:
        found.append(likeliest(engine, grown[best]))
    highest = min(found, key=_value)
    return highest.vector if _value(highest) < _value(likeliest(engine, vector)) - HIGHER else None


def _value(point: Likeliest) -> float:
    return point.value if np.isfinite(point.value) else float("inf")


def _scaled(engine: FilterEngine, vector: Array, entries: Integers, factor: float) -> Array:
    """The vector with the sizes at `entries` multiplied by a factor, inside of their bounds."""
    parameters, out = engine.parameters, vector.copy()
    maps = parameters.bijections(tuple(parameters.shared[i - parameters.n_weights] for i in entries))
    natural = maps.to_natural(torch.from_numpy(vector[entries])).numpy()
    out[entries] = maps.inside(maps.from_natural(factor * natural))
    return out


__all__ = ["near_none"]
