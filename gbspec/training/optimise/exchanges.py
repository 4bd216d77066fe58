"""Other values of constants at which a likelihood may be as high: constants whose roles are exchanged.

Of two constants x and y these are y and x (the rates of two steps in line, of which the order does not show), and z/y
and z/x with z = 1 or another constant (a rate and the time of a memory; ka and V of a clearance CL = z, whose rate of
elimination is CL/V). What else depends on the ratio r of the exchange, as a volume does, is multiplied or divided by
it, or two other constants are exchanged too, as the amplitudes of two exponentials. In logarithms each of these is a
matrix M that is its own inverse; where units are declared, they must stay those of the constants.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, islice

import numpy as np

from gbspec.arrays import Array
from gbspec.training.optimise.equal import differ
from gbspec.training.problem import Bijections, Integers

CONSIDERED = 5000
"""At most so many pairs and so many exchanges are looked at: k constants without units have about k^5/8 of these."""


def exchanges(values: Array, declared: Array, maps: Bijections, units: Array) -> Iterator[Array]:
    """The matrices M [k, k] of exchanges of positive constants by which the natural `values` [k] change clearly and
    stay inside of their bounds, each made when it is asked for: first those of two constants with the values of each
    other; of these first pairs whose order is not that of the `declared` values [k], then the nearest. `units` [k, d]
    are the exponents of units. At most `CONSIDERED` are looked at, possible or not.
    """
    place, left = maps.from_natural(values), iter(range(CONSIDERED))
    for turned in (False, True):
        found: list[tuple[bool, float, _Places]] = []
        for places, _ in zip(_of_pairs(values, units, turned), left, strict=False):
            first, (i, j, _) = exchanged(values, _matrix(len(values), places, turned)), places
            if _inside(first, maps) and differ(first, values):
                as_declared = (values[i] < values[j]) == (declared[i] < declared[j])
                found.append((as_declared, float(np.linalg.norm(maps.from_natural(first) - place)), places))
        for *_, places in sorted(found, key=lambda each: each[:2]):
            matrix = _matrix(len(values), places, turned)
            yield matrix
            for one, _ in zip(_with_others(matrix, places[:2]), left, strict=False):
                if _possible(values, one, units) and _inside(exchanged(values, one), maps):
                    yield one


def exchanged(values: Array, matrix: Array) -> Array:
    """The natural values [k] after an exchange."""
    out, moved = values.copy(), _moved(matrix)
    with np.errstate(all="ignore"):
        out[moved] = np.exp(matrix[np.ix_(moved, _used(matrix))] @ np.log(values[_used(matrix)]))
    return out


_Places = tuple[int, int, int]
"""The places of x, y and z in an exchange of a pair; that of z is -1 where z is 1, or does not occur."""


def _of_pairs(values: Array, units: Array, turned: bool) -> Iterator[_Places]:
    """The exchanges of pairs alone of positive constants that keep their units: y and x, or, `turned` over, z/y and
    z/x."""
    positive = values > 0
    for i, j in islice(combinations(np.flatnonzero(positive).tolist(), 2), CONSIDERED):
        if not turned:
            if np.allclose(units[i], units[j]):
                yield i, j, -1
            continue
        product = units[i] + units[j]
        if np.allclose(product, 0.0):
            yield i, j, -1
        fits = positive & np.isclose(units, product).all(axis=1)
        yield from ((i, j, k) for k in np.flatnonzero(fits).tolist() if k not in (i, j))


def _matrix(count: int, places: _Places, turned: bool) -> Array:
    """The matrix [k, k] of the exchange of a pair alone."""
    i, j, z = places
    matrix = np.eye(count)
    matrix[i, i] = matrix[j, j] = 0.0
    matrix[i, j] = matrix[j, i] = -1.0 if turned else 1.0
    if z >= 0:
        matrix[i, z] = matrix[j, z] = 1.0
    return matrix


def _with_others(matrix: Array, pair: tuple[int, int]) -> Iterator[Array]:
    """The exchange of a pair with each other constant multiplied or divided by its ratio, and with each other pair
    exchanged."""
    i, _ = pair
    ratio = np.eye(len(matrix))[i] - matrix[i]
    others = [k for k in range(len(matrix)) if k not in pair and matrix[i, k] == 0]
    for k in others:
        for sign in (1, -1):
            out = matrix.copy()
            out[k] += sign * ratio
            yield out
    for a, b in combinations(others, 2):
        out = matrix.copy()
        out[[a, b]] = out[[b, a]]
        yield out


def _moved(matrix: Array) -> Integers:
    """The constants that change."""
    return np.flatnonzero((matrix != np.eye(len(matrix))).any(axis=1)).astype(np.int64)


def _used(matrix: Array) -> Integers:
    """The constants from which those follow that change."""
    return np.flatnonzero((matrix[_moved(matrix)] != 0).any(axis=0)).astype(np.int64)


def _possible(values: Array, matrix: Array, units: Array) -> bool:
    """Whether the constants have logarithms, and those that change keep their units."""
    return bool((values[_used(matrix)] > 0).all()) and np.allclose(matrix @ units, units)


def _inside(values: Array, maps: Bijections) -> bool:
    """Whether all values lie inside of their bounds."""
    return all(one.low < value < one.high for one, value in zip(maps.each, values, strict=True))
