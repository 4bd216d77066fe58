"""Other values of constants at which a likelihood may be as high: constants whose roles are exchanged.

Of two constants x and y these are y and x (the rates of two steps in line, of which the order does not show), and z/y
and z/x with z = 1 or another constant (a rate and the time of a memory; ka and V of a clearance CL = z, whose rate of
elimination is CL/V). What else depends on the ratio r of the exchange, as a volume does, is multiplied or divided by
it, or two other constants are exchanged too, as the amplitudes of two exponentials. In logarithms each of these is a
matrix M that is its own inverse; where units are declared, they must stay those of the constants.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import combinations

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Learnable
from gbspec.training.optimise.equal import differ
from gbspec.training.problem import Bijections, Integers

_FACTOR = re.compile(r"(^|[*/])([^*/^()]+)(?:\^\(?(-?\d+(?:/\d+)?)\)?)?")
"""A factor of a unit in canonical form, such as `kg*m^2/s^(1/2)`."""


def exchanges(values: Array, declared: Array, maps: Bijections, units: Array) -> list[Array]:
    """The matrices M [k, k] of exchanges of positive constants by which the natural `values` [k] change clearly and
    stay inside of their bounds: first those of two constants with the values of each other; of these first pairs whose
    order is not that of the `declared` values [k], then the nearest. `units` [k, d] are the exponents of units.
    """
    found: list[tuple[bool, bool, float, list[Array]]] = []
    place = maps.from_natural(values)
    for pair in combinations(range(len(values)), 2):
        i, j = pair
        turned = (values[i] < values[j]) != (declared[i] < declared[j])
        for matrix in _of_pair(len(values), pair):
            first = exchanged(values, matrix)
            if not (_possible(values, matrix, units) and _inside(first, maps) and differ(first, values)):
                continue
            further = (one for one in _with_others(matrix, pair) if _possible(values, one, units))
            family = [matrix, *(one for one in further if _inside(exchanged(values, one), maps))]
            distance = float(np.linalg.norm(maps.from_natural(first) - place))
            found.append((matrix[i, j] < 0, not turned, distance, family))
    found.sort(key=lambda each: each[:3])
    return [one for *_, family in found for one in family]


def exchanged(values: Array, matrix: Array) -> Array:
    """The natural values [k] after an exchange."""
    out, moved = values.copy(), _moved(matrix)
    with np.errstate(all="ignore"):
        out[moved] = np.exp(matrix[np.ix_(moved, _used(matrix))] @ np.log(values[_used(matrix)]))
    return out


def exponents(learnables: Sequence[Learnable]) -> Array:
    """The exponents [k, d] of the units of constants; without columns where none has a unit."""
    tables = [_powers(k.unit or "1") for k in learnables]
    names = sorted({name for table in tables for name in table})
    rows = [[float(table.get(name, 0)) for name in names] for table in tables]
    return np.array(rows).reshape(len(tables), len(names))


def _powers(unit: str) -> dict[str, Fraction]:
    table: dict[str, Fraction] = {}
    for sign, name, exponent in _FACTOR.findall(unit):
        if name.strip() != "1":
            power = Fraction(exponent or 1) * (-1 if sign == "/" else 1)
            table[name] = table.get(name, Fraction(0)) + power
    return table


def _of_pair(count: int, pair: tuple[int, int]) -> Iterator[Array]:
    """The matrices of the exchanges of a pair alone."""
    i, j = pair
    for sign, z in ((1, -1), (-1, -1), *((-1, k) for k in range(count) if k not in pair)):
        matrix = np.eye(count)
        matrix[i, i] = matrix[j, j] = 0.0
        matrix[i, j] = matrix[j, i] = sign
        if z >= 0:
            matrix[i, z] = matrix[j, z] = 1.0
        yield matrix


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
