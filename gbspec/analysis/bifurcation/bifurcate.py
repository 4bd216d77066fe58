"""Bifurcation diagrams over one parameter: branches of steady states, and branches of limit cycles.

Steady states are searched for from many initial guesses at several values of the parameter; each that is on no branch
found so far starts a new branch, and the branches that cross at branch points are followed too. Branches of cycles
start at Hopf points and, at parameters without a known stable solution, from the orbit to which the flow converges; at
period doublings the cycles of twice the period are followed. Truth and fitted runs use the same functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from gbspec.analysis.bifurcation.continuation import Branch, Kind, SpecialPoint, SteadyCurve
from gbspec.analysis.bifurcation.curve import CurvePoint, Steps
from gbspec.analysis.bifurcation.cycles import CycleBranch, CycleCurve, CycleOptions
from gbspec.analysis.bifurcation.diagram import Diagram
from gbspec.analysis.bifurcation.hopf import analyse_hopf
from gbspec.analysis.bifurcation.known import on_curve
from gbspec.analysis.bifurcation.limit_cycle import Cycle
from gbspec.analysis.bifurcation.settle import settle
from gbspec.analysis.systems import Family, System, steady_states
from gbspec.arrays import Array
from gbspec.diagnostics import Findings


@dataclass(frozen=True)
class BifurcationOptions:
    """Options of a diagram: for the search for steady states and the continuation of branches and cycles."""

    values: int = 9
    """The number of parameter values, ends included, at which steady states are searched for."""
    starts: int = 64
    cycles: bool = True
    most_branches: int = 40
    steps: Steps = field(default_factory=Steps)
    cycle: CycleOptions = field(default_factory=CycleOptions)
    seed: int = 0


def bifurcate(
    system: System,
    over: str,
    low: float,
    high: float,
    options: BifurcationOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagram:
    """The bifurcation diagram over `low` <= `over` <= `high`, everything else at the system's values.

    Raises UserError if there is no such parameter (GB872), if the system depends on time (GB873) or a number is missing
    (GB871), and if the range is invalid (GB875).
    """
    options = options or BifurcationOptions()
    require_range(over, low, high)
    family = Family(system, over)
    explorer = _Explorer(SteadyCurve(family, low, high, options.steps), options, progress or (lambda text: None))
    explorer.steady()
    if options.cycles and system.delayed is None:  # cycles are collocated without a past
        explorer.cycles_from_hopf()
        explorer.cycles_from_flow()
    bounds = system.trained.get(over, system.range(over))
    return Diagram(
        name=system.name,
        parameter=over,
        low=low,
        high=high,
        states=system.states,
        branches=tuple(explorer.branches),
        special=tuple(sorted(explorer.special, key=lambda point: (point.value, point.kind))),
        cycles=tuple(explorer.cycles),
        trained=bounds if np.isfinite(bounds).all() else None,
    )


def require_range(name: str, low: float, high: float) -> None:
    """Raises UserError (GB875) unless `low` < `high` are valid ends of a range."""
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        findings = Findings()
        findings.error(
            "GB875",
            f"`{name}` cannot be varied from {low:.6g} to {high:.6g}",
            None,
            help="give two numbers, the lower one first: `--range 0.2 0.5`",
        )
        findings.raise_if_failed()


class _Explorer:
    """Finds and collects the branches of a diagram."""

    def __init__(self, curve: SteadyCurve, options: BifurcationOptions, progress: Callable[[str], None]) -> None:
        self.curve, self.options, self.progress = curve, options, progress
        self.followed: list[list[CurvePoint]] = []
        self.lone: list[tuple[CurvePoint, tuple[str, str]]] = []
        self.branches: list[Branch] = []
        self.special: list[SpecialPoint] = []
        self.cycles: list[CycleBranch] = []
        self.values = np.linspace(curve.low, curve.high, options.values)

    # ------------------------------------------------------------------ steady states
    def steady(self) -> None:
        """Finds all branches of steady states that are reached from the initial guesses."""
        family = self.curve.family
        # Inner values first: a branch that crosses the whole range is then followed once, in both directions.
        order = sorted(self.values, key=lambda value: abs(value - (self.curve.low + self.curve.high) / 2.0))
        for value in order:
            seeds = np.array([points[len(points) // 2].y[:-1] * self.curve.scale[:-1] for points in self.followed])
            found = steady_states(
                family.at(float(value)), starts=self.options.starts, seed=self.options.seed, extra=seeds
            )
            for one in found:
                self._explore(one.state, float(value))
            self.progress(f"steady states at {family.name} = {value:.6g}: {len(found)}")
        for point, ends in self.lone:
            if not self._known(point.y):
                self._list([point], [], ends)

    def _explore(self, state: Array, value: float) -> None:
        """Follows the branch through a steady state in both directions, unless it is known."""
        start = self.curve.start(state, value, forward=True)
        if start is None or self._known(start.y):
            return
        crossing = self.curve.crossing(start)
        if crossing is not None:
            self._cross(crossing)
            return
        back = CurvePoint(start.y, -start.tangent, start.derivative)
        self._follow([start, back], start)

    def _known(self, y: Array) -> bool:
        """Whether a scaled point is a known branch point, all branches of which are followed, or lies on a branch."""
        return any(point.kind == "branch" and self._same(point, y) for point in self.special) or any(
            on_curve(self.curve.curve, y, points) for points in self.followed
        )

    def _same(self, point: SpecialPoint, y: Array) -> bool:
        return bool(np.max(np.abs(self.curve.scaled(point.state, point.value) - y)) < 1e-5)

    def _cross(self, at: CurvePoint) -> None:
        """Follows the branches through a branch point that are not known yet."""
        for tangent in self.curve.crossing_tangents(at):
            sides = [self._side(at, direction) for direction in (tangent, -tangent)]
            starts = [one for one in sides if one is not None]
            number = len(self.branches)
            if starts:
                self._follow(starts, None)
            if len(self.branches) > number:
                self._mark("branch", at, number)

    def _side(self, at: CurvePoint, tangent: Array) -> CurvePoint | None:
        """The first point of a branch from a branch point, unless it is known or not admissible."""
        point = self.curve.switch(at, tangent)
        if point is None:
            return None
        state, value = self.curve.unscaled(point.y)
        inside = self.curve.low <= value <= self.curve.high and self.curve.family.system.admissible(state)
        return point if inside and not self._known(point.y) else None

    def _follow(self, starts: list[CurvePoint], middle: CurvePoint | None) -> None:
        """Adds the branch that begins with one point or two, to both sides of `middle` or of a branch point."""
        ahead = self.curve.follow(starts[0])
        if ahead.end == "closed":
            self._add(ahead.points, ahead.special, ("closed", "closed"))
        elif len(starts) == 1:
            self._add(ahead.points, ahead.special, ("branch point", ahead.end))
        else:
            behind = self.curve.follow(starts[1])
            before = behind.points[::-1] if middle is None else behind.points[:0:-1]
            self._add(before + ahead.points, behind.special + ahead.special, (behind.end, ahead.end))

    def _add(self, points: list[CurvePoint], found: list[tuple[Kind, CurvePoint]], ends: tuple[str, str]) -> None:
        """Adds a branch of more than one point; a single one may be a degenerate point of a branch that is not yet
        followed, from which no direction is defined."""
        if len(points) > 1:
            self._list(points, found, ends)
        else:
            self.lone.append((points[0], ends))

    def _list(self, points: list[CurvePoint], found: list[tuple[Kind, CurvePoint]], ends: tuple[str, str]) -> None:
        """Lists a branch and its special points, and follows the branches that cross it."""
        if len(self.branches) >= self.options.most_branches:
            return
        self.followed.append(points)
        number = len(self.branches)
        self.branches.append(Branch(tuple(self.curve.steady_point(point.y) for point in points), ends))
        crossings = [point for kind, point in found if kind == "branch"]
        for kind, point in found:
            # The side branch of a pitchfork turns at the crossing: that is its branch point, not a fold.
            if kind == "fold" and any(np.max(np.abs(point.y - other.y)) < 1e-5 for other in crossings):
                continue
            self._mark(kind, point, number)
        for point in crossings:
            self._cross(point)

    def _mark(self, kind: Kind, point: CurvePoint, branch: int) -> None:
        """Adds a special point, a Hopf point with its criticality; at a known one, that a branch crosses there."""
        state, value = self.curve.unscaled(point.y)
        if not self.curve.family.system.admissible(state):
            return
        for i, other in enumerate(self.special):
            if other.kind == kind and self._same(other, point.y):
                if kind == "branch" and branch not in other.branches:
                    self.special[i] = replace(other, branches=(*other.branches, branch))
                return
        if kind == "hopf" and self.curve.family.system.delayed is not None:
            frequency = self._frequency(point)
            special = SpecialPoint("hopf", value, state, branch, frequency, period=2 * np.pi / frequency)
        elif kind == "hopf":
            hopf = analyse_hopf(self.curve.family, state, value)
            special = SpecialPoint("hopf", value, state, branch, hopf.frequency, hopf.l1, hopf.criticality, hopf.period)
        else:
            crossed = (branch,) if kind == "branch" else ()
            special = SpecialPoint(kind, value, state, branch, branches=crossed)
        self.special.append(special)

    def _frequency(self, point: CurvePoint) -> float:
        """The imaginary part of the characteristic root that is nearest to the imaginary axis."""
        roots = self.curve.eigenvalues(point.y)
        roots = roots[roots.imag > 0]
        return float(roots[np.argmin(np.abs(roots.real))].imag)

    # ------------------------------------------------------------------ cycles
    def cycles_from_hopf(self) -> None:
        """Follows the cycles born at each Hopf point, unless another branch of cycles ends there."""
        curve = CycleCurve(self.curve.family, self.curve.low, self.curve.high, self.options.cycle)
        for point in [one for one in self.special if one.kind == "hopf"]:
            if self._ends_at(point):
                continue
            hopf = analyse_hopf(self.curve.family, point.state, point.value)
            branch = curve.from_hopf(point.state, point.value, hopf)
            self._keep(curve, branch)
            self.progress(f"cycles from the Hopf point at {point.value:.6g}: {len(branch.cycles)} ({branch.end})")

    def _ends_at(self, point: SpecialPoint) -> bool:
        """Whether a branch of cycles found so far ends at this Hopf point."""
        scale = self.curve.scale
        for branch in self.cycles:
            if branch.end != "hopf":
                continue
            last = branch.cycles[-1]
            apart = np.abs((last.maximum + last.minimum) / 2.0 - point.state) / scale[:-1]
            size = float(np.max((last.maximum - last.minimum) / scale[:-1]))
            if abs(last.value - point.value) / scale[-1] < 0.02 and np.max(apart) < max(0.01, size):
                return True
        return False

    def cycles_from_flow(self) -> None:
        """Follows cycles from the orbits to which the flow converges, at parameters without a known stable solution."""
        curve = CycleCurve(self.curve.family, self.curve.low, self.curve.high, self.options.cycle)
        for value in self.values[1:-1]:
            if self._something_stable(float(value)):
                continue
            orbit = settle(self.curve.family, float(value), self._start(float(value)))
            place = None if orbit is None else curve.at(orbit.period, orbit.states, float(value))
            if place is None or curve.known(place, self.cycles):
                continue
            ahead, behind = curve.from_cycle(place)
            whole = replace(
                ahead,
                cycles=behind.cycles[:0:-1] + ahead.cycles,
                found=behind.found + ahead.found,
                end="closed" if ahead.end == "closed" else f"{behind.end}; {ahead.end}",
                doublings=behind.doublings + ahead.doublings,
                places=behind.places[:0:-1] + ahead.places,
            )
            self._keep(curve, whole)
            self.progress(f"cycles found by simulation at {value:.6g}: {len(ahead.cycles) + len(behind.cycles)}")

    def _something_stable(self, value: float) -> bool:
        """Whether stable steady states or cycles are known on both sides of a value, close to it."""
        near = 0.6 * (self.values[1] - self.values[0])
        for branch in self.branches:
            for a, b in zip(branch.points[:-1], branch.points[1:], strict=True):
                if min(a.value, b.value) <= value <= max(a.value, b.value) and (a.stable or b.stable):
                    return True
        for cycles in self.cycles:
            stable = np.array([cycle.value for cycle in cycles.cycles if cycle.stable])
            if stable.size and np.min(np.abs(stable - value)) < near:
                below, above = stable[stable <= value], stable[stable >= value]
                if below.size and above.size:
                    return True
        return False

    def _start(self, value: float) -> Array:
        """An initial state for the flow: next to an unstable steady state, else the middle of the box."""
        low, high = self.curve.family.system.start_box
        for branch in self.branches:
            values = branch.values
            i = int(np.argmin(np.abs(values - value)))
            if abs(values[i] - value) < 0.05 * self.curve.scale[-1]:
                return np.asarray(np.clip(branch.states[i] + 0.02 * (high - low), low, high))
        return np.asarray((low + high) / 2.0)

    def _keep(self, curve: CycleCurve, branch: CycleBranch, doubled: int = 0) -> None:
        """Adds a branch of cycles with its special points, then those of twice the period (`doubled`: how often)."""
        number = len(self.cycles)
        # The middle: where a branch begins, another that was followed to this end may have stopped a step before.
        if branch.places and curve.known(branch.places[len(branch.places) // 2], self.cycles):
            return
        self.cycles.append(branch)
        for kind, cycle in branch.found:
            self.special.append(SpecialPoint(kind, cycle.value, cycle.states[0], number, period=cycle.period))
        if doubled == self.options.cycle.doublings:
            return
        for place in branch.doublings:
            at = curve.cycle(place)
            if len(self.cycles) >= self.options.most_branches or self._doubled_before(at):
                continue
            followed = curve.from_doubling(place)
            self.progress(f"cycles of twice the period from {at.value:.6g}: {len(followed.cycles)} ({followed.end})")
            self._keep(curve, followed, doubled + 1)

    def _doubled_before(self, at: Cycle) -> bool:
        """Whether a branch of cycles of twice the period, followed before, ends at this period doubling."""
        for branch in self.cycles:
            if branch.end != "period doubling":
                continue
            last = branch.cycles[-1]
            near = abs(last.value - at.value) / self.curve.scale[-1] < 0.02
            if near and abs(last.period / (2.0 * at.period) - 1.0) < 0.02:
                return True
        return False
