"""The restricted likelihood of the sizes of disturbances and noises.

The likelihood at its maximum takes the other entries (weights, constants, initial states) as if they were known, so
that it ascribes too little to disturbances and noises, the more the fewer values there are for each of them: it divides
by n where n - p is right. The restricted likelihood (Patterson and Thompson 1971; its approximation for models that are
not linear: Harville 1977) has the other entries integrated out. In Laplace's approximation this adds log det H_dd / 2
to the negative log likelihood, H_dd being their information.

A constant may change variances as sizes do: a disturbance that decays at a rate k has the variance s^2/(2k). As one of
the other entries it would follow a size to wherever their ratio stays. So where constants l shift readings by known
amounts (`observe y = m + x`), others have a gradient of their own, of log det H_ll / 2, as parameters of the variances
of a linear mixed model have. Elsewhere (m of x' = k (m - x)) H_ll would also change with what l does to the means, and
the more slowly that is the less would it be: a flat prior of l is none there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.problem import Integers

FLAT = 1e-8
"""Smallest information of an entry: a diffusion or a noise that goes to zero has none."""
LEAST = 1e-7
"""The smallest information of a combination of entries, over the largest, whose change can be told from rounding."""
MOVED = 0.01
"""The term is computed again where the logarithm of a size has changed by this, or that of the weights' precision by
twice as much."""
STEP = 1e-3
"""Step of the differences, on the scale of training."""
OLD = 10
"""The term is computed again after so many iterations."""


def sizes(engine: FilterEngine) -> Integers:
    """The entries of the vector that are sizes of disturbances (constants that trajectories share and that occur in
    `diffusion` alone) or of noises."""
    parameters, model = engine.parameters, engine.problem.model
    inside = {symbol for diffusion in model.diffusions for symbol in diffusion.value.free_symbols}
    elsewhere = {symbol for value in model.inlined(model.balances) for symbol in value.free_symbols}
    shared = [
        parameters.n_weights + place
        for place, index in enumerate(parameters.shared)
        if model.learnables[index].symbol in inside - elsewhere
    ]
    noises = np.arange(parameters.size, engine.layout.size)
    return np.concatenate([np.array(shared, dtype=np.int64), noises.astype(np.int64)])


@dataclass(frozen=True)
class Restricted:
    """The gradient [size] of log det H_dd / 2 by the sizes, of log det H_ll / 2 by constants beside those that
    shift readings, zero elsewhere, with where and how long ago it was found.

    An iteration maximises the likelihood with this gradient held; where it rests, the restricted likelihood does.
    """

    slope: Array
    at: Array
    age: int

    @classmethod
    def none(cls, size: int) -> Restricted:
        """No term: the likelihood itself."""
        return cls(np.zeros(size), np.zeros(0), 0)

    def fits(self, at: Array) -> bool:
        """Whether the term is still that of the entries `at`, the last of which is the logarithm of a precision."""
        if self.age >= OLD or len(at) != len(self.at):
            return False
        moved = np.abs(at - self.at)
        moved[-1] *= 0.5
        return bool((moved <= MOVED).all())


def shifts(engine: FilterEngine) -> Integers:
    """The entries of constants, shared by all trajectories, that occur in channels alone, with normal noise, and shift
    their readings by amounts that depend on no state and no other constant; none in models with networks, events, doses
    or algebraic variables."""
    model, parameters = engine.problem.model, engine.parameters
    if parameters.n_weights or model.events or model.doses or model.algebraics or model.constraints:
        return np.zeros(0, dtype=np.int64)
    diffusions, starts = (one.value for one in model.diffusions), (state.initial.value for state in model.states)
    noises = [one.noise.value for one in model.channels if one.noise is not None]
    elsewhere = [*model.balances, *diffusions, *(one for one in (*starts, *noises) if one is not None)]
    inside = set[sympy.Basic]().union(*(value.free_symbols for value in model.inlined(elsewhere)))
    values = model.inlined([one.value for one in model.channels])
    moving = {one.symbol for one in (*model.learnables, *model.states)}
    found = []
    for place, index in enumerate(parameters.shared):
        symbol = model.learnables[index].symbol
        of = [(one, value) for one, value in zip(model.channels, values, strict=True) if symbol in value.free_symbols]
        normal = all(one.noise is None or one.noise.kind == "normal" for one, _ in of)
        if symbol not in inside and normal and not any(value.diff(symbol).free_symbols & moving for _, value in of):
            found.append(parameters.places.start + place)
    return np.array(found, dtype=np.int64)


def place_of(engine: FilterEngine, entries: Integers, vector: Array, ridge: float) -> Array:
    """What the term depends on most: the `entries`, which are sizes, shared constants in models without networks, and
    the logarithm of the weights' precision."""
    places = engine.parameters.places
    constants = vector[places] if not engine.parameters.n_weights else vector[:0]
    return np.concatenate([vector[entries], constants, [np.log(max(ridge, 1e-300))]])


def slope(
    engine: FilterEngine, entries: Integers, vector: Array, found: Filtered, information: Array, matrix: Array
) -> Array:
    """The gradient [size] of log det H_dd / 2 by the `entries`, H_dd being the block of other free entries, and that
    of constants beside those that shift readings.

    `matrix` is the `information` at `vector` with priors, and `found` the filter there. The gradient is that of the
    linear model that the filter has found: half the trace of H_dd^-1 and the change of the information of means. That
    of variances does not change with a common factor of all sizes.
    """
    out, free = np.zeros(len(vector)), engine.layout.free
    others = np.where(np.diag(matrix) > 0, free, 0.0)
    others[entries] = 0.0
    entries = entries[free[entries] > 0]
    if len(entries) and others.any():
        values, axes = np.linalg.eigh(inverse(matrix, others, LEAST))
        factor = axes[:, values > 0] * np.sqrt(values[values > 0])
        out[entries] = 0.5 * engine.information_change(vector, found, factor, entries)
    return out + _of_constants(engine, entries, vector, found, matrix, matrix - information)


def _of_constants(
    engine: FilterEngine, entries: Integers, vector: Array, found: Filtered, matrix: Array, priors: Array
) -> Array:
    """The gradient [size] of log det H_ll / 2 by the other shared constants, l being those of `shifts`, by differences;
    zero for the `entries`, which are sizes, and in models with networks."""
    out, parameters = np.zeros(len(vector)), engine.parameters
    shifting = np.zeros(len(vector))
    shifting[shifts(engine)] = 1.0
    shifting *= engine.layout.free
    if not shifting.any():
        return out
    covariance, shared = inverse(matrix, shifting, LEAST), np.arange(parameters.places.start, parameters.places.stop)
    for entry in shared[(engine.layout.free[shared] > 0) & (shifting[shared] == 0)]:
        if entry in entries:
            continue
        there = vector.copy()
        there[entry] += STEP
        information = engine.information(there, engine.filtered(there, guess=found.guess))
        change = float(np.sum(covariance * (information.matrix + priors - matrix))) / STEP
        out[entry] = 0.5 * change if np.isfinite(information.value) else 0.0
    return out


def inverse(matrix: Array, free: Array, least: float) -> Array:
    """The inverse of the information of the free entries, zero elsewhere and for combinations that have less than
    `least` of the information of the largest."""
    out, chosen = np.zeros_like(matrix), np.flatnonzero(free > 0)
    block = matrix[np.ix_(chosen, chosen)]
    scale = 1 / np.sqrt(np.maximum(np.diag(block), FLAT))
    scaled = np.linalg.pinv(block * np.outer(scale, scale), rcond=least, hermitian=True)
    out[np.ix_(chosen, chosen)] = scaled * np.outer(scale, scale)
    return out


__all__ = ["FLAT", "Restricted", "inverse", "place_of", "shifts", "sizes", "slope"]
