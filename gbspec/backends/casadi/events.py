"""Trajectories of models with events, by scipy's adaptive methods, restarted at each event.

Times of events are roots of the methods' dense output. This solver shares nothing with the steps of the generated
module but its equations, so that tests compare both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.backends.casadi.cvodes import FINEST, LOCAL, InitialValueProblem
from gbspec.backends.casadi.timeline import Segment
from gbspec.backends.protocol import Casadi, GeneratedModule
from gbspec.diagnostics import ComputationError

if TYPE_CHECKING:
    from scipy.integrate import OdeSolver

Flags = NDArray[np.bool_]

SAMPLES = 24
"""Places within a step of the solver at which conditions are looked at; maxima between them are refined."""
MANY = 100_000
"""Most steps between two events."""
LOOK, UNSTABLE = 100, 3.0
"""After every so many steps between two events it is looked whether the fastest decay limits them: steps times its rate
are at the limit of stability of the explicit method then, which is about twice this number."""
CASCADE = 100
"""Most events at one time."""
SHORT, CLOSE = 30, 1e-11
"""So many events that follow each other within this share of the trajectory have no end."""


@dataclass
class _Place:
    """Where a trajectory is: time and state, which conditions are true, and the next time of each timed event."""

    time: float
    state: Array
    on: Flags
    turn: list[int]
    short: int = 0


class EventSolver:
    """Solves one instance's equations; `rhs` is its casadi.Function, `jacobian` that of its derivatives."""

    def __init__(self, instance: GeneratedModule, rhs: Casadi, jacobian: Casadi) -> None:
        self._instance, self._rhs, self._jacobian = instance, rhs, jacobian
        self._math = instance.arithmetic("numpy")
        self._networks = instance.numpy_networks()
        self._events = instance.equations.events
        self._timed = sum(timed for _, timed, _ in self._events)

    def run(
        self, x0: Array, begin: float, outputs: Array, pieces: Sequence[Segment], problem: InitialValueProblem
    ) -> Array:
        """States [n_times, n_states] at `outputs`, each before what happens at that time; the segments cover [begin,
        outputs[-1]]. Raises ComputationError."""
        return _Trajectory(self, begin, outputs, problem).run(x0, pieces)


class _Trajectory:
    def __init__(self, solver: EventSolver, begin: float, outputs: Array, problem: InitialValueProblem) -> None:
        self.solver, self.begin, self.outputs, self.problem = solver, begin, outputs, problem
        self.constants = tuple(np.float64(value) for value in problem.constants)
        self.span = max(float(outputs[-1]) - begin, 1e-300)
        self.states = np.full((len(outputs), len(problem.scales)), np.nan)
        self.recorded = outputs <= begin
        self.stiff = False
        self.piece = Segment(begin, begin, np.zeros(0), np.zeros(0), np.zeros(0))
        self.timing: tuple[tuple[float | None, ...], ...] = ()
        if solver._timed:
            found = solver._instance.equations.timing(solver._math, problem.condition, self.constants)
            self.timing = tuple(tuple(None if v is None else float(v) for v in each) for each in found)

    def run(self, x0: Array, pieces: Sequence[Segment]) -> Array:
        self.states[self.outputs <= self.begin] = x0
        place = _Place(self.begin, np.array(x0, dtype=np.float64), np.zeros(0, dtype=bool), [0] * len(self.timing))
        for number, piece in enumerate(pieces):
            if number:
                earlier = self.guards(place.time, place.state)
            self.piece = piece
            place.state = place.state + piece.jump
            guard = self.guards(place.time, place.state)
            if not number:
                earlier = self.guards(place.time, np.array(x0, dtype=np.float64))
                place.on = earlier >= 0
                armed = np.array([a for _, timed, a in self.solver._events if not timed], dtype=bool)
                pending = (guard >= 0) & (armed | ~place.on)
            else:
                pending = (guard >= 0) & (earlier < 0) & ~place.on
            place.on &= guard >= 0
            self.happen(place, np.concatenate([np.zeros(self.solver._timed, dtype=bool), pending]), jumped=True)
            self.advance(place)
        return self.states

    # ---------------------------------------------------------------- equations
    def inputs(self, time: float | Array) -> Array:
        elapsed = np.asarray(time) - self.piece.begin
        return np.asarray(self.piece.inputs + self.piece.slopes * elapsed[..., None], dtype=np.float64)

    def rate(self, time: float, state: Array) -> Array:
        first, last = self.piece.insets  # where a formula jumps at an end, the side within counts
        time = min(max(time, self.piece.begin + first), self.piece.end - last)
        found = self.solver._rhs(time, state, self.problem.condition, self.inputs(time), self.problem.constants)
        return np.array(found).ravel()

    def slopes(self, time: float, state: Array) -> Array:
        """The derivatives of the rates by the states."""
        given = self.problem.condition, self.inputs(time), self.problem.constants
        return np.array(self.solver._jacobian(time, state, *given), dtype=np.float64)

    def guards(self, time: float | Array, state: Array) -> Array:
        """The guards [..., W] at times [...] and states [..., n]."""
        equations, math = self.solver._instance.equations, self.solver._math
        u, networks = self.inputs(time), self.solver._networks
        with np.errstate(all="ignore"):
            found = equations.guards(math, time, state, self.problem.condition, u, self.constants, networks)
        return np.asarray(found, dtype=np.float64)

    def rates(self, time: float, state: Array) -> Array:
        """How fast the guards change."""
        size = 1e-7 * self.span
        after = self.guards(time + size, state + size * self.rate(time, state))
        return np.asarray((after - self.guards(time, state)) / size, dtype=np.float64)

    # ---------------------------------------------------------------- in time
    def advance(self, place: _Place) -> None:
        """Goes to the end of the piece, through the events before it."""
        while place.time < self.piece.end:
            began = place.time
            times = [self.next(k, place) for k in range(len(self.timing))]
            stop = min([*times, self.piece.end])
            pending = np.zeros(len(self.solver._events), dtype=bool)
            if stop > place.time:
                pending[self.solver._timed :] = self.until(place, stop)
            if stop < self.piece.end and place.time >= stop - 1e-13 * self.span:
                pending[: len(times)] = [time <= stop for time in times]
            place.short = place.short + 1 if pending.any() and place.time - began <= CLOSE * self.span else 0
            if place.short > SHORT:
                self.fail(place, "events follow each other at ever shorter intervals")
            self.happen(place, pending)

    def next(self, k: int, place: _Place) -> float:
        """The next time of a timed event."""
        first, every, until = self.timing[k]
        start = self.begin if first is None else first
        slack = CLOSE * self.span
        while True:
            number = place.turn[k]
            if number and (every is None or not every > 0):
                return np.inf
            time = start + number * (every or 0.0)
            if until is not None and time > until + slack:
                return np.inf
            if time >= self.begin - slack:
                return max(time, place.time)
            place.turn[k] += 1

    def until(self, place: _Place, stop: float) -> Flags:
        """Goes to the first event with a condition, or to `stop`, and records the states on the way."""
        none = np.zeros(len(place.on), dtype=bool)
        solver, steps = self.method(place.time, place.state, stop), 0
        leaving = ~place.on
        while solver.status == "running":
            if steps % LOOK == LOOK - 1 and not self.stiff and self.limits(solver):
                self.stiff = True
                solver = self.method(solver.t, solver.y, stop)
            solver.step()
            steps += 1
            if solver.status == "failed" or steps > MANY or not np.isfinite(solver.y).all():
                self.fail(place, "the trajectory cannot be integrated further")
            dense = solver.dense_output()
            time, found = self.first(place, dense, solver.t_old, solver.t, leaving)
            self.record(dense, time + (CLOSE * self.span if found.any() else 0.0))
            place.time, place.state = time, np.array(dense(time)) if found.any() else solver.y.copy()
            if found.any():
                return found
            leaving = none
        return none

    def method(self, time: float, state: Array, stop: float) -> OdeSolver:
        """The method for what follows: explicit until the equations have shown that they are stiff."""
        from scipy.integrate import DOP853, Radau

        rtol = max(self.problem.rtol * LOCAL, FINEST * 10)
        atol = max(self.problem.atol * LOCAL, FINEST) * self.problem.scales
        if not self.stiff:
            return DOP853(self.rate, time, state, stop, rtol=rtol, atol=atol)
        return Radau(self.rate, time, state, stop, rtol=rtol, atol=atol, jac=self.slopes)

    def limits(self, solver: OdeSolver) -> bool:
        """Whether a decay, and not the error, limits the steps of the explicit method."""
        slopes = self.slopes(solver.t, solver.y)
        modes = np.linalg.eigvals(slopes) if np.isfinite(slopes).all() else np.zeros(1)
        fastest = modes[np.abs(modes).argmax()]
        return bool(fastest.real < 0 and abs(fastest) * solver.step_size > UNSTABLE)

    def record(self, dense: Callable[[Array], Array], end: float) -> None:
        """Keeps the states up to a time; those at the time of an event are those before it."""
        inside = ~self.recorded & (self.outputs <= end)
        if inside.any():
            self.states[inside] = np.asarray(dense(self.outputs[inside])).T
            self.recorded |= inside

    def first(
        self, place: _Place, dense: Callable[[Array], Array], start: float, end: float, leaving: Flags
    ) -> tuple[float, Flags]:
        """The first time in a step at which a condition becomes true, and which; else its end."""
        times = np.linspace(start, end, SAMPLES + 1)
        guards = self.guards(times, np.asarray(dense(times)).T)
        found = np.full(guards.shape[1], np.inf)
        on = place.on.copy()
        for j in range(guards.shape[1]):
            found[j], on[j] = self._one(dense, times, guards[:, j], bool(on[j]), bool(leaving[j]), j)
        earliest = float(found.min(initial=np.inf))
        if not np.isfinite(earliest):
            place.on = on
            return end, np.zeros(len(found), dtype=bool)
        place.on = place.on & (self.guards(earliest, np.asarray(dense(np.array(earliest)))) >= 0)
        return earliest, found <= earliest + 1e-14 * self.span

    def _one(
        self, dense: Callable[[Array], Array], times: Array, values: Array, on: bool, leaving: bool, j: int
    ) -> tuple[float, bool]:
        """The time at which one condition becomes true, and whether it is true at the end."""
        from scipy.optimize import brentq, minimize_scalar

        def value(time: float) -> float:
            return float(self.guards(time, np.asarray(dense(np.array(time))))[j])

        for i in range(1, len(times)):
            low, high = float(times[i - 1]), float(times[i])
            if on:
                on = bool(values[i] >= 0)
                continue
            if values[i] < 0 and i > 1 and values[i - 1] > values[i] and values[i - 1] >= values[i - 2]:
                top = minimize_scalar(lambda t: -value(t), bounds=(float(times[i - 2]), high), method="bounded")
                if -top.fun > 0:
                    return float(brentq(value, float(times[i - 2]), top.x, xtol=1e-300, rtol=1e-15)), True
            if values[i] < 0:
                continue
            if i == 1 and leaving and not values[0] < -1e-9 * np.abs(values).max():
                size = high - low  # at zero up to rounding, and going below it: the place where it is surely negative
                while size > 1e-300 and value(low + size) >= 0 and low + size > low:
                    size /= 2
                if low + size <= low:
                    return low, True
                low += size
            elif values[i - 1] >= 0:
                return low, True
            return float(brentq(value, low, high, xtol=1e-300, rtol=1e-15)), True
        return np.inf, on

    # ---------------------------------------------------------------- what events do
    def happen(self, place: _Place, pending: Flags, jumped: bool = False) -> None:
        """Carries out the pending events and those that they cause."""
        equations, math, timed = self.solver._instance.equations, self.solver._math, self.solver._timed
        for _ in range(CASCADE):
            if not pending.any():
                return
            k = self.next_one(place, pending)
            pending[k] = False
            u = self.inputs(place.time)
            earlier = self.guards(place.time, place.state)
            with np.errstate(all="ignore"):
                states = equations.happen(
                    math, place.time, place.state, self.problem.condition, u, self.constants, self.solver._networks
                )
            place.state = np.array(states[k], dtype=np.float64)
            self.check(place, k)
            guard = self.guards(place.time, place.state)
            fired = np.zeros(len(guard), dtype=bool)
            if k < timed:
                place.turn[k] += 1
            else:
                fired[k - timed] = True
            # A guard that the event did not change is zero up to rounding: only its rate says which sign follows.
            rates = self.rates(place.time, place.state)
            zone = 2 * CLOSE * self.span * np.abs(rates)
            zero = (guard == earlier) & (np.abs(guard) <= zone)
            still = np.where(zero & (not jumped), rates > 0, guard >= 0)
            pending[timed:] |= ~place.on & ~fired & (guard >= 0) & ((earlier < 0) | (guard > zone))
            place.on = (place.on | fired) & still
        self.fail(place, f"more than {CASCADE} events happen at one time")

    def next_one(self, place: _Place, pending: Flags) -> int:
        """The number of the pending event that comes first: timed ones, then by priority, then as they are listed."""
        equations, math, timed = self.solver._instance.equations, self.solver._math, self.solver._timed
        if not hasattr(equations, "ranks") or pending[:timed].any():
            return int(np.argmax(pending))
        u, networks = self.inputs(place.time), self.solver._networks
        ranks = equations.ranks(math, place.time, place.state, self.problem.condition, u, self.constants, networks)
        sizes = np.nan_to_num(np.asarray(ranks, dtype=np.float64), nan=-np.finfo(np.float64).max)
        return int(np.argmax(np.where(pending, sizes, -np.inf)))

    def check(self, place: _Place, k: int) -> None:
        """Raises ComputationError if an event gave a state no value."""
        lost = [n for n, v in zip(self.solver._instance.states, place.state, strict=True) if not np.isfinite(v)]
        if lost:
            name = self.solver._events[k][0]
            raise ComputationError(
                f"the event `{name}` sets `{lost[0]}` to what is not a finite number",
                where=f"at t = {place.time:.6g}",
                remedy="look at its right sides; an event that begins again while it waits needs `queue n`",
            )

    def fail(self, place: _Place, what: str) -> None:
        names = self.solver._instance.states
        values = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, place.state, strict=True))
        zeno = "events" in what
        raise ComputationError(
            what,
            where=f"at t = {place.time:.6g}, where {values}",
            remedy="add an event that ends this, such as one that lets the ball rest, or shorten the span"
            if zeno
            else "change the initial state, shorten the span, or look at the equations there",
        )
