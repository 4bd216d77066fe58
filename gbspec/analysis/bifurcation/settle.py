"""What the flow settles to: the first guess of a stable limit cycle, by integration and its returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbspec.analysis.systems import Family
from gbspec.arrays import Array

Field = Callable[[float, Array], Array]

TOLERANCE = 1e-8
ROUNDS = 8
"""How often the time for settling is doubled before the flow counts as not periodic."""
CLOSED = 2e-3
"""An orbit counts as closed when it comes back within this part of its own extent."""


@dataclass(frozen=True)
class Settled:
    """A nearly closed orbit: its period and states [P, n] at P equal parts of it, the end left out."""

    period: float
    states: Array


def settle(family: Family, value: float, start: Array, samples: int = 400) -> Settled | None:
    """The periodic orbit that the flow settles to from `start` [n]; None where it finds none.

    The time scale comes from the Jacobian at the start; the time for settling grows until the orbit comes back to
    where it was. The period is the time between two passages of a hyperplane across the flow, after as many passages
    as it takes to come back to the same place.
    """
    from scipy.integrate import solve_ivp

    n = family.size

    def rhs(_: float, x: Array) -> Array:
        return family.rhs(x, value)[0]

    def jacobian(_: float, x: Array) -> Array:
        return family.linear(x, value)[1].reshape(n, n)

    scale = family.system.scale
    x = start
    span = 50.0 * _time_scale(jacobian(0.0, x))
    for _ in range(ROUNDS):
        solution = solve_ivp(rhs, (0.0, span), x, "LSODA", rtol=1e-6, atol=1e-9 * scale, jac=jacobian)
        if not solution.success or not np.isfinite(solution.y[:, -1]).all():
            return None
        x = solution.y[:, -1]
        if np.linalg.norm(rhs(0.0, x) / scale) * span < 1e-6:
            return None
        orbit = _returned(rhs, jacobian, x, span, scale, samples)
        if orbit is not None:
            return orbit
        span *= 2.0
    return None


def _time_scale(jacobian: Array) -> float:
    """The time of the slowest mode, leaving out those that hardly move."""
    rates = np.abs(np.linalg.eigvals(jacobian))
    largest = float(rates.max()) or 1.0
    return float(1.0 / np.min(rates[rates > 1e-4 * largest], initial=largest))


def _returned(rhs: Field, jacobian: Field, x: Array, span: float, scale: Array, samples: int) -> Settled | None:
    """The orbit from `x` if it comes back to it within the span."""
    from scipy.integrate import solve_ivp
    from scipy.optimize import brentq

    flow = rhs(0.0, x) / scale
    normal = flow / np.linalg.norm(flow)
    solution = solve_ivp(
        rhs, (0.0, span), x, "LSODA", rtol=TOLERANCE, atol=1e-10 * scale, jac=jacobian, dense_output=True
    )
    if not solution.success:
        return None

    def across(time: float) -> float:
        return float(((solution.sol(time) - x) / scale) @ normal)

    extent = np.ptp(solution.y / scale[:, None], axis=1).max()
    side = np.array([across(time) for time in solution.t])
    for i in np.flatnonzero((side[1:-1] < 0.0) & (side[2:] >= 0.0)) + 1:
        time = float(brentq(across, solution.t[i], solution.t[i + 1], xtol=1e-12 * span))
        if np.max(np.abs((solution.sol(time) - x) / scale)) < CLOSED * extent:
            return Settled(time, solution.sol(time * np.arange(samples) / samples).T)
    return None
