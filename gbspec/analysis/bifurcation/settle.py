"""A first guess of a stable limit cycle: the orbit to which the flow converges, by integration and return times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gbspec.analysis.systems import Family
from gbspec.arrays import Array

Field = Callable[[float, Array], Array]

TOLERANCE = 1e-8
ROUNDS = 8
"""How often the transient time is doubled before the flow counts as not periodic."""
CLOSED = 2e-3
"""An orbit counts as closed when it returns to within this fraction of its extent."""

FARTHEST = 1e6
"""Solutions with a state this many times its scale are given up."""


@dataclass(frozen=True)
class Settled:
    """A nearly closed orbit: its period and states [P, n] at P equidistant times, without the end."""

    period: float
    states: Array


def settle(family: Family, value: float, start: Array, samples: int = 400) -> Settled | None:
    """The periodic orbit to which the flow converges from `start` [n]; None if none is found.

    The time scale comes from the Jacobian at `start`; the transient time grows until the orbit returns to a previous
    point. The period is the time between two crossings of a hyperplane transverse to the flow, after as many crossings
    as it takes to return to the same point.
    """
    n = family.size

    def rhs(_: float, x: Array) -> Array:
        return family.rhs(x, value)[0]

    def jacobian(_: float, x: Array) -> Array:
        return family.linear(x, value)[1].reshape(n, n)

    scale = family.system.scale
    x = start
    span = 50.0 * _time_scale(jacobian(0.0, x))
    for _ in range(ROUNDS):
        end = _followed(rhs, jacobian, x, span, scale)
        if end is None:
            return None
        x = end
        if np.linalg.norm(rhs(0.0, x) / scale) * span < 1e-6:
            return None
        orbit = _returned(rhs, jacobian, x, span, scale, samples)
        if orbit is not None:
            return orbit
        span *= 2.0
    return None


def _followed(rhs: Field, jacobian: Field, x: Array, span: float, scale: Array) -> Array | None:
    """Where the flow leads within a time; None where it goes so far off that it is on no orbit, as a solution that
    blows up in finite time, which would otherwise be followed by ever shorter steps."""
    from scipy.integrate import LSODA

    solver = LSODA(rhs, 0.0, x, span, rtol=1e-6, atol=1e-9 * scale, jac=jacobian)
    while solver.status == "running":
        solver.step()
        if solver.status == "failed" or not np.max(np.abs(solver.y / scale)) < FARTHEST:
            return None
    return np.asarray(solver.y)


def _time_scale(jacobian: Array) -> float:
    """The time scale of the slowest mode, except modes that are nearly constant."""
    rates = np.abs(np.linalg.eigvals(jacobian))
    largest = float(rates.max()) or 1.0
    return float(1.0 / np.min(rates[rates > 1e-4 * largest], initial=largest))


def _returned(rhs: Field, jacobian: Field, x: Array, span: float, scale: Array, samples: int) -> Settled | None:
    """The orbit from `x` if it returns to `x` within the span."""
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
