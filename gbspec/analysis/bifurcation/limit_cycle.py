"""A limit cycle at one value of a parameter, in the user's units: period, extremes and Floquet multipliers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.bifurcation.collocation import Orbit
from gbspec.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from gbspec.analysis.systems import Family


@dataclass(frozen=True)
class Cycle:
    """A limit cycle at one value of the parameter: period, extremes [n] and Floquet multipliers by decreasing modulus.

    `times` [P] over one period and `states` [P, n] sample it; `stable` ignores the trivial multiplier 1; `outside`
    names the quantities that leave their trained (else plausible) ranges on it.
    """

    value: float
    period: float
    maximum: Array
    minimum: Array
    multipliers: ComplexArray
    times: Array = field(repr=False)
    states: Array = field(repr=False)
    outside: tuple[str, ...] = ()

    @property
    def stable(self) -> bool:
        """Whether all multipliers except the trivial one are inside the unit circle."""
        return bool(np.all(np.abs(others(self.multipliers)) < 1.0))


@dataclass(frozen=True)
class Place:
    """A point of the curve of cycles: orbit, unit tangent and multipliers."""

    orbit: Orbit
    tangent: Orbit
    multipliers: ComplexArray


def others(multipliers: ComplexArray) -> ComplexArray:
    """The multipliers without the trivial one (the one closest to 1)."""
    return np.delete(multipliers, int(np.argmin(np.abs(multipliers - 1.0))))


def limit_cycle(family: Family, scale: Array, width: float, orbit: Orbit, multipliers: ComplexArray) -> Cycle:
    """An orbit in the user's units: its states are in units of `scale` [n], its parameter in units of `width`."""
    nodes = np.interp(np.arange(8 * orbit.intervals) / 8.0, np.arange(orbit.intervals + 1), orbit.mesh)
    s = np.unique(np.concatenate([orbit.mesh, nodes]))
    period = float(np.exp(orbit.log_period))
    maximum, minimum = extremes(orbit)
    value = orbit.parameter * width
    along = orbit.at(s) * scale
    return Cycle(
        value=value,
        period=period,
        maximum=maximum * scale,
        minimum=minimum * scale,
        multipliers=multipliers,
        times=s * period,
        states=along,
        outside=family.at(value).outside(along),
    )


def extremes(orbit: Orbit, parts: int = 16) -> tuple[Array, Array]:
    """Largest and smallest value [n] of the collocation polynomials, from a fine sample refined by parabolas."""
    fine = np.interp(np.arange(parts * orbit.intervals) / parts, np.arange(orbit.intervals + 1), orbit.mesh)
    values = orbit.at(fine)
    before, after = np.roll(values, 1, axis=0), np.roll(values, -1, axis=0)
    back = np.diff(np.concatenate([[fine[-1] - 1.0], fine]))[:, None]
    ahead = np.diff(np.concatenate([fine, [1.0 + fine[0]]]))[:, None]
    # Newton's form of the parabola through three neighbours, at its vertex if that is between them.
    slope = ((values - before) / back * ahead + (after - values) / ahead * back) / (back + ahead)
    bend = ((after - values) / ahead - (values - before) / back) / (back + ahead)
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = np.where(bend != 0.0, -slope / (2.0 * bend), 0.0)
    vertex = np.clip(np.nan_to_num(vertex), -back, ahead)
    refined = values + vertex * (slope + vertex * bend)
    columns = np.arange(values.shape[1])
    return refined[values.argmax(axis=0), columns], refined[values.argmin(axis=0), columns]
