"""From fits with a constant held at successive values to a profile: where fits are made, and what they show.

What is fitted is the profiler's: whole solutions by least squares (`likelihood`), or a marginal likelihood
(`marginal`). Fits go outwards from the estimate until the crossing of the threshold is known on either side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.runs import ProfileRecord, Run, write_profile
from gbspec.training.problem import Bijection
from gbspec.training.profile.agreement import OTHER_BEST, Found, compared
from gbspec.training.profile.places import Beside, Places, along_entries
from gbspec.training.profile.possible import of_fit
from gbspec.training.profile.result import Profile, ProfilePoint
from gbspec.training.profile.said import said_of_better, said_of_bounds
from gbspec.training.profile.side import Known, Side, closely

ENDED = 2e-3
"""A profile that begins so close to a bound, as a share of the range, begins at it."""
NOTHING = 0.01
"""Closer to it than this part of the deviation, no value towards it can differ from the estimate."""
Report = Callable[[float, float], None]


@dataclass(frozen=True)
class Fitted:
    """A fit with the constant at `value`: its vector and its objective, the fraction of the fit's step at which it was
    made, and whether half of it has the same objective (`exact`)."""

    value: float
    theta: Array
    objective: float
    converged: bool
    fraction: float = 1.0
    exact: bool = True


@dataclass
class Basis:
    """What a profile is computed from: the constant's `name` and the `column` of its entry in the vector, the
    `threshold` of the deviance, the `map` of the constant's bounds, the entry's standard `deviation`, beside a bound
    the `part` of the range that it is there, the objective's `unit` of the deviance, and the noise (None: the
    likelihood contains it). `failed` is the value at which nothing could be fitted, by the direction from the
    estimate."""

    name: str
    column: int
    threshold: float
    map: Bijection
    deviation: float = 0.0
    part: float = math.inf
    unit: float = 1.0
    noise: float | None = None
    failed: dict[float, float] = field(default_factory=dict)

    def deviance(self, one: Fitted, best: Fitted) -> float:
        """The deviance of a fit from another one."""
        return (one.objective - best.objective) / self.unit

    def bound(self, value: float, direction: float) -> float | None:
        """The bound in a direction, if the value with which the profile has begun is at it."""
        bound = self.map.low if direction < 0 else self.map.high
        return bound if self.map.distance(value, bound) <= ENDED else None

    def beside(self, value: float) -> Beside | None:
        """The range beside the bound at which the value is with which the profile has begun."""
        found = [bound for bound in (self.bound(value, -1.0), self.bound(value, 1.0)) if bound is not None]
        return Beside(self.map, value, found[0]) if found else None

    def places(self, begun: Fitted, direction: float) -> Places | None:
        """The places in a direction; None if a bound leaves none."""
        entry, level, value = float(begun.theta[self.column]), math.sqrt(self.threshold), begun.value
        beside = self.beside(value)
        if beside is None:
            return along_entries(entry, level * self.deviation, direction)
        bound = self.bound(value, direction)
        if bound is not None and self.map.distance(value, bound) <= NOTHING * min(self.part, 1.0):
            return None
        return beside.places(level * self.part, direction)


class Profiler(Protocol):
    """Fits with the constant held."""

    model: Model
    basis: Basis

    def held(self, entry: float, neighbour: Fitted) -> Fitted:
        """The fit with the constant's entry of the vector at `entry`, beginning from a neighbour; its objective is not
        finite where nothing could be fitted."""

    def others(self, one: Fitted) -> dict[str, float]:
        """The other learned constants of a fit."""

    def said_of_estimate(self, estimate: float) -> list[str]:
        """A note where the estimate is not the value of the run's member."""

    def remarks(self, fits: Sequence[Fitted]) -> list[str]:
        """What is to be said of the fits beside the profile itself."""


def profile_from(
    run: Run, member: int, profiler: Profiler, best: Fitted, points: int, progress: Report | None, narrowed: float = 0.0
) -> Profile:
    """The profile around a fit with all parameters free, recorded in the run beside the fit's interval."""
    found = [best]
    for direction in (-1.0, 1.0):
        found += _side(profiler, best, direction, points, progress)
    whole = _assembled(member, best, sorted(found, key=lambda one: one.value), profiler)
    return _judged(run, whole, profiler, narrowed)


def _judged(run: Run, found: Profile, profiler: Profiler, narrowed: float) -> Profile:
    """The profile beside the fit's estimate and interval, recorded in the run."""
    value, interval = of_fit(run, found.name)
    place = Found(found.estimate, found.low, found.high, found.settled, narrowed)
    verdict = compared(place, value, interval, len(run.numbers))
    ends = (found.low, found.high)
    write_profile(
        run.path,
        ProfileRecord(found.name, found.member, found.estimate, ends, verdict.trust, verdict.words or None),
    )
    told = () if OTHER_BEST in verdict.words else profiler.said_of_estimate(found.estimate)
    return replace(found, notes=(*told, *found.notes), fitted=interval, comparison=verdict)


def _side(profiler: Profiler, best: Fitted, direction: float, most: int, progress: Report | None) -> list[Fitted]:
    """The fits on one side of the estimate, until its crossing of the threshold is known, or `most` are made."""
    basis, found = profiler.basis, {0.0: best}
    places = basis.places(best, direction)
    if places is None:
        return []
    side, outwards = Side(), 0.0
    for _ in range(most):
        place = min(side.next, places.last)
        neighbour = found[min(found, key=lambda one: abs(one - place))]
        here = profiler.held(places.entry(place), neighbour)
        outwards = outwards or here.value - best.value
        if not math.isfinite(here.objective):
            basis.failed[direction] = here.value
            break
        # The map of a constant whose starting value is on its bound turns back there.
        if not (here.value - found[side.inside.place].value) * outwards > 0:
            break
        found[place] = here
        deviance = basis.deviance(here, best)
        if progress is not None:
            progress(here.value, deviance)
        side.tell(place, math.sqrt(max(deviance, 0.0) / basis.threshold))
        if side.complete:
            break
    return [one for place, one in found.items() if place]


def _assembled(member: int, begun: Fitted, fits: list[Fitted], profiler: Profiler) -> Profile:
    """The profile: deviances relative to the best of all fits, and where they cross the threshold; it has `begun` at
    the run's fit."""
    basis, least = profiler.basis, min(fits, key=lambda one: one.objective)
    name, at, level = basis.name, fits.index(least), math.sqrt(basis.threshold)
    points = tuple(
        ProfilePoint(one.value, basis.deviance(one, least), profiler.others(one), one.converged) for one in fits
    )
    notes = [
        f"nothing could be fitted with {name} = {value:.4g}: the profile ends before it on this side"
        for value in basis.failed.values()
    ]
    sides = {"lower": points[at::-1], "upper": points[at:]}
    low, high = (_crossing(side, level) for side in sides.values())
    # Where the fit ended at a bound, the interval does too: nothing lies beyond it.
    low, high = (
        (basis.bound(begun.value, -1.0) if low is None else low),
        (basis.bound(begun.value, 1.0) if high is None else high),
    )
    slow = sum(not point.converged for point in points)
    if slow:
        low = high = None
        notes.append(f"{slow} of {len(points)} fits have not converged, so that their deviances are too large and no "
                     "interval can be given: allow more `--iterations`")  # fmt: skip
    else:
        both = (("below", low, -1.0), ("above", high, 1.0))
        open_sides = [side for side, end, sign in both if end is None and sign not in basis.failed]
        notes += [f"the data do not bound {name} {side}, as far as it was followed" for side in open_sides]
        notes += [text for which, side in sides.items() for text in _said_of_gap(which, side, level)]
    notes += said_of_better(name, points[fits.index(begun)], points[at])
    for side in sides.values():
        notes += said_of_bounds(profiler.model, name, points[at].others, side[1:])
    notes += profiler.remarks(fits)
    return Profile(name, member, least.value, points, low, high, basis.noise, tuple(notes), basis.threshold)


def _enclosing(points: tuple[ProfilePoint, ...], level: float) -> tuple[Known, Known] | None:
    """The first two points outwards between which the root of the deviance crosses a level, by their distances from the
    first of all and their roots over this level."""
    known = [Known(p.value - points[0].value, math.sqrt(max(p.deviance, 0.0)) / level) for p in points]
    return next(((a, b) for a, b in pairwise(known) if a.root <= 1.0 < b.root), None)


def _crossing(points: tuple[ProfilePoint, ...], level: float) -> float | None:
    """Where the root of the deviance first crosses a level outwards, by interpolation (it is linear for a parabola)."""
    found = _enclosing(points, level)
    if found is None:
        return None
    a, b = found
    return points[0].value + a.place + (1.0 - a.root) / (b.root - a.root) * (b.place - a.place)


def _said_of_gap(which: str, points: tuple[ProfilePoint, ...], level: float) -> list[str]:
    """A sentence if an end of the interval lies anywhere between two points that are far from each other."""
    found = _enclosing(points, level)
    if found is None or closely(*(Known(abs(one.place), one.root) for one in found)):
        return []
    first, second = (f"{points[0].value + one.place:.4g}" for one in found)
    return [
        f"the {which} end is interpolated between {first} and {second}, which are far apart: more `--points` locate it "
        "better"
    ]
