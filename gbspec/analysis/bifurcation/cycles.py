"""Limit cycles over one parameter, with period and multipliers, from Hopf points or from stable orbits of the flow.

Pseudo-arclength continuation of the collocation equations; the mesh is adapted as the cycle changes shape. The
continuation passes folds of cycles; they, period doublings and torus points are located by Brent's method along the
curve. At a period doubling, the cycles of twice the period branch off as at a pitchfork, along the mode of the
multiplier -1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.bifurcation.collocation import (
    DEGREE,
    PARAMETER_FIXED,
    Collocation,
    Functional,
    Orbit,
    adapted_mesh,
    along,
    error_estimate,
    inner,
    phase,
)
from gbspec.analysis.bifurcation.known import on_cycles
from gbspec.analysis.bifurcation.limit_cycle import Cycle, Place, limit_cycle, others
from gbspec.arrays import Array, ComplexArray, Mask

if TYPE_CHECKING:
    from gbspec.analysis.bifurcation.continuation import Kind
    from gbspec.analysis.bifurcation.hopf import Hopf
    from gbspec.analysis.systems import Family


@dataclass(frozen=True)
class CycleOptions:
    """Options of the continuation of cycles: step lengths in scaled variables, mesh intervals, and limits."""

    first: float = 0.01
    least: float = 1e-5
    most: float = 0.05
    turn: float = 0.97
    intervals: int = 24
    most_intervals: int = 120
    accuracy: float = 1e-5
    points: int = 400
    doublings: int = 1
    """How often a period may double: 1 follows the cycles of twice the period, 2 also those of four times."""
    longest: float = 30.0
    """The period, relative to that of the first cycle, above which a cycle counts as approaching a homoclinic orbit."""


@dataclass(frozen=True)
class CycleBranch:
    """Cycles in the order of continuation, the special points among them, and the reason for the end of the branch.

    `found` holds (kind, cycle) of folds of cycles, period doublings and torus points; `start` describes its origin;
    `doublings` are the points from which `CycleCurve.from_doubling` continues, `places` those of the cycles.
    """

    cycles: tuple[Cycle, ...]
    found: tuple[tuple[Kind, Cycle], ...]
    end: str
    start: str = "hopf"
    doublings: tuple[Place, ...] = field(default=(), repr=False)
    places: tuple[Place, ...] = field(default=(), repr=False)


class CycleCurve:
    """The cycles of a family over `low` <= p <= `high`."""

    def __init__(self, family: Family, low: float, high: float, options: CycleOptions | None = None) -> None:
        self.family, self.low, self.high = family, low, high
        self.options = options or CycleOptions()
        self.equations = Collocation(family, family.system.scale, high - low)

    # ------------------------------------------------------------------ starts
    def from_hopf(self, state: Array, value: float, hopf: Hopf) -> CycleBranch:
        """The branch of cycles born at a Hopf point."""
        scale, width = self.equations.scale, self.equations.width
        mesh = np.linspace(0.0, 1.0, self.options.intervals + 1)
        s = (mesh[:-1, None] + np.diff(mesh)[:, None] * (np.arange(DEGREE) / DEGREE)).ravel()
        mode = np.real(np.exp(2j * np.pi * s)[:, None] * hopf.vector) / scale
        center = Orbit(mesh, np.tile(state / scale, (len(s), 1)), float(np.log(hopf.period)), value / width)
        direction = Orbit(mesh, mode, 0.0, 0.0)
        direction = _scaled(direction, 1.0 / np.sqrt(inner(direction, direction)))
        return self._leave(center, direction, phase(direction), "hopf")

    def from_doubling(self, at: Place) -> CycleBranch:
        """The branch of cycles of twice the period that begins where a multiplier passes -1."""
        center = at.orbit.twice()
        return self._leave(center, self.equations.flip(at.orbit), phase(center), "period doubling")

    def _leave(self, center: Orbit, direction: Orbit, kept: Functional, origin: str) -> CycleBranch:
        """The branch from a bifurcation at `center` in `direction`; `kept` fixes the phase of its first cycle."""
        length = self.options.first
        while length > self.options.least:
            guess = center.moved(direction, length)
            corrected = self.equations.correct(guess, (kept, along(direction)))
            if corrected is not None:
                orbit = corrected[0]
                tangent = self.equations.tangent(orbit, direction, phase(orbit))
                if tangent is not None and inner(tangent, direction) > 0.5:
                    place = Place(orbit, tangent, self.equations.multipliers(orbit))
                    return self._follow(place, float(np.exp(center.log_period)), length / 2.0, origin)
            length /= 3.0
        return CycleBranch((), (), "no cycle was found where the branch begins", origin)

    def at(self, period: float, states: Array, value: float) -> Place | None:
        """The cycle at exactly this parameter near an orbit sampled at equal times, `states` [P, n] without its end."""
        scale, width = self.equations.scale, self.equations.width
        s = np.arange(len(states) + 1) / len(states)
        closed = np.vstack([states, states[:1]]) / scale
        intervals = 2 * self.options.intervals
        # The first mesh follows the arc length of the orbit, which resolves relaxation oscillations at once.
        arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        mesh = np.interp(np.linspace(0.0, 1.0, intervals + 1), (arc / arc[-1] + s) / 2.0, s)
        nodes = (mesh[:-1, None] + np.diff(mesh)[:, None] * (np.arange(DEGREE) / DEGREE)).ravel()
        values = np.column_stack([np.interp(nodes, s, column) for column in closed.T])
        orbit = Orbit(mesh, values, float(np.log(period)), value / width)
        for _ in range(3):
            corrected = self.equations.correct(orbit, (phase(orbit), PARAMETER_FIXED), iterations=20)
            if corrected is None:
                return None
            orbit = corrected[0]
            if error_estimate(orbit) < self.options.accuracy:
                break
            orbit = orbit.remeshed(adapted_mesh(orbit, min(self.options.most_intervals, int(1.5 * orbit.intervals))))
        if _apart(orbit) < 1e-4:
            # Near a period doubling the flow converges so slowly that two rounds may have been taken for one.
            return self.at(period / 2.0, states[: len(states) // 2], value)
        upward = Orbit(orbit.mesh, np.zeros_like(orbit.nodes), 0.0, 1.0)
        tangent = self.equations.tangent(orbit, upward, phase(orbit))
        return None if tangent is None else Place(orbit, tangent, self.equations.multipliers(orbit))

    def from_cycle(self, place: Place) -> tuple[CycleBranch, CycleBranch]:
        """The branch through a cycle, followed to larger and smaller values of the parameter, unless it is closed."""
        period = float(np.exp(place.orbit.log_period))
        ahead = self._follow(place, period, self.options.first, "settled")
        if ahead.end == "closed":
            return ahead, CycleBranch((self.cycle(place),), (), "closed", "settled", (), (place,))
        back = replace(place, tangent=_scaled(place.tangent, -1.0))
        return ahead, self._follow(back, period, self.options.first, "settled")

    def known(self, place: Place, branches: Iterable[CycleBranch]) -> bool:
        """Whether a cycle is on one of the branches."""
        return any(on_cycles(self.equations, place.orbit, branch.places) for branch in branches)

    # ------------------------------------------------------------------ following
    def _follow(self, start: Place, period: float, length: float, origin: str) -> CycleBranch:
        options = self.options
        here = start
        places, found = [start], list[tuple["Kind", Place]]()
        end = "number of points"
        while len(places) < options.points:
            if length < options.least:
                end = "no step converged"
                break
            following = self._step(here, length)
            if following is None:
                length /= 2.0
                continue
            place, iterations = following
            value = place.orbit.parameter * self.equations.width
            if value < self.low or value > self.high:
                last = self._at_end(here, self.low if value < self.low else self.high)
                places.extend([last] if last is not None else [])
                end = "range"
                break
            changes = self._changes(here, place, length)
            if self._vanishes(here, place, changes):
                end = "hopf" if _amplitude(place.orbit) < 2.0 * options.most else "period doubling"
                break
            found.extend(changes)
            end = self._reason_to_stop(place, start, period, len(places) + 1)
            places.append(start if end == "closed" else place)
            if end:
                break
            end = "number of points"
            here = self._remeshed(place) if len(places) % 3 == 0 else place
            length = min(options.most, 1.4 * length) if iterations <= 4 else length * (0.7 if iterations > 6 else 1.0)
        special = tuple((kind, self.cycle(at)) for kind, at in found)
        doublings = tuple(at for kind, at in found if kind == "period_doubling")
        return CycleBranch(tuple(map(self.cycle, places)), special, end, origin, doublings, tuple(places))

    def _step(self, here: Place, length: float) -> tuple[Place, int] | None:
        guess = here.orbit.moved(here.tangent, length)
        corrected = self.equations.correct(guess, (phase(here.orbit), along(here.tangent)))
        if corrected is None:
            return None
        orbit, iterations = corrected
        tangent = self.equations.tangent(orbit, here.tangent, phase(here.orbit))
        if tangent is None or inner(tangent, here.tangent) < self.options.turn:
            return None
        return Place(orbit, tangent, self.equations.multipliers(orbit)), iterations

    def _at_end(self, here: Place, value: float) -> Place | None:
        """The cycle at an end of the range."""
        target = value / self.equations.width
        rate = here.tangent.parameter
        guess = here.orbit.moved(here.tangent, (target - here.orbit.parameter) / rate) if rate else here.orbit
        guess = replace(guess, parameter=target)
        corrected = self.equations.correct(guess, (phase(here.orbit), PARAMETER_FIXED))
        if corrected is None:
            return None
        return Place(corrected[0], here.tangent, self.equations.multipliers(corrected[0]))

    def _remeshed(self, place: Place) -> Place:
        """The same cycle on an adapted mesh, with more intervals if the error requires them."""
        count, error = place.orbit.intervals, error_estimate(place.orbit)
        if error > self.options.accuracy:
            growth = min(1.5, max(1.05, (error / self.options.accuracy) ** (1.0 / (DEGREE + 1))))
            count = max(count, min(self.options.most_intervals, int(np.ceil(growth * count))))
        mesh = adapted_mesh(place.orbit, count)
        return replace(place, orbit=place.orbit.remeshed(mesh), tangent=place.tangent.remeshed(mesh))

    def _reason_to_stop(self, place: Place, start: Place, period: float, count: int) -> str:
        if np.exp(place.orbit.log_period) > self.options.longest * period:
            return f"the period passes {self.options.longest * period:.6g}: close to a homoclinic orbit"
        if count > 10:
            apart = abs(place.orbit.parameter - start.orbit.parameter) + abs(
                place.orbit.log_period - start.orbit.log_period
            )
            apart += abs(_amplitude(place.orbit) - _amplitude(start.orbit))
            if apart < 0.2 * self.options.most and place.tangent.parameter * start.tangent.parameter > 0.0:
                return "closed"
        return ""

    def _vanishes(self, a: Place, b: Place, changes: list[tuple[Kind, Place]]) -> bool:
        """Whether the difference of the halves of a cycle passes zero (Hopf point or doubling), which ends the branch.

        Beyond it the curve continues through the same cycles shifted by half a period, so the parameter turns back.
        """
        if a.tangent.parameter * b.tangent.parameter >= 0.0:
            return False
        folds = [at for kind, at in changes if kind == "cycle_fold"]
        if folds:
            return _apart(folds[0].orbit) < 1e-3
        return min(_apart(a.orbit), _apart(b.orbit)) < self.options.most

    # ------------------------------------------------------------------ special points
    def _changes(self, a: Place, b: Place, length: float) -> list[tuple[Kind, Place]]:
        """The special points within one step; a fold at zero amplitude is the Hopf point at which the branch ends."""
        found: list[tuple[Kind, Place]] = []
        if a.tangent.parameter * b.tangent.parameter < 0.0:
            self._locate(a, length, "cycle_fold", lambda place: place.tangent.parameter, found)
        if not (_trustworthy(a.multipliers) and _trustworthy(b.multipliers)):
            return found
        before, after = others(a.multipliers), others(b.multipliers)
        if _count(before, _beyond_minus_one) != _count(after, _beyond_minus_one):
            self._locate(a, length, "period_doubling", lambda place: _flip(place.multipliers), found)
        rank = min(_count(before, _outside), _count(after, _outside))
        if abs(_count(before, _outside) - _count(after, _outside)) == 2 and abs(after[rank].imag) > 1e-6:
            self._locate(a, length, "torus", lambda place: float(abs(others(place.multipliers)[rank])) - 1.0, found)
        return found

    def _locate(
        self,
        a: Place,
        length: float,
        kind: Kind,
        test: Callable[[Place], float],
        found: list[tuple[Kind, Place]],
    ) -> None:
        """Adds the zero of `test` within a step from `a`, if it can be found."""
        from scipy.optimize import brentq

        seen: dict[float, Place] = {0.0: a}

        def value(s: float) -> float:
            if s not in seen:
                following = self._step(a, s)
                if following is None:
                    raise ArithmeticError
                seen[s] = following[0]
            return test(seen[s])

        try:
            if value(0.0) * value(length) > 0.0:
                return
            root = float(brentq(value, 0.0, length, xtol=1e-10, rtol=1e-12, maxiter=40))
            value(root)
        except ArithmeticError:
            return
        found.append((kind, seen[root]))

    # ------------------------------------------------------------------ results
    def cycle(self, place: Place) -> Cycle:
        """The cycle in the user's units."""
        return limit_cycle(self.family, self.equations.scale, self.equations.width, place.orbit, place.multipliers)


def _scaled(orbit: Orbit, factor: float) -> Orbit:
    return Orbit(orbit.mesh, factor * orbit.nodes, factor * orbit.log_period, factor * orbit.parameter)


def _amplitude(orbit: Orbit) -> float:
    """Half of the largest extent of any state, in scaled variables."""
    return float(np.max(orbit.nodes.max(axis=0) - orbit.nodes.min(axis=0))) / 2.0


def _apart(orbit: Orbit) -> float:
    """Half of the largest distance of a cycle from itself half a period later, in scaled variables.

    It vanishes if the amplitude does, and if the cycle is one of half the period traversed twice.
    """
    s = np.arange(8 * orbit.intervals) / (16.0 * orbit.intervals)
    return float(np.max(np.abs(orbit.at(s + 0.5) - orbit.at(s)))) / 2.0


def _count(multipliers: ComplexArray, which: Callable[[ComplexArray], Mask]) -> int:
    return int(np.sum(which(multipliers)))


def _trustworthy(multipliers: ComplexArray) -> bool:
    """Whether the small multipliers are accurate: near a homoclinic orbit they are lost to rounding."""
    return bool(np.min(np.abs(multipliers - 1.0)) < 1e-3 and np.abs(multipliers[0]) < 1e10)


def _outside(multipliers: ComplexArray) -> Mask:
    return np.abs(multipliers) > 1.0


def _beyond_minus_one(multipliers: ComplexArray) -> Mask:
    return (multipliers.real < -1.0) & (np.abs(multipliers.imag) < 1e-9)


def _flip(multipliers: ComplexArray) -> float:
    """The product of (1 + multiplier) over the multipliers near or below -1; it changes sign where one passes -1."""
    return float(np.prod(1.0 + multipliers).real)
