"""Trajectories of models with delays, by the method of steps on scipy's DOP853 with its dense output.

Steps end where jumps show again after delays, and are no longer than the shortest delay, so that every delayed value
lies in a piece of the solution that is known. This solver shares nothing with the steps of the generated module but its
equations, so that tests compare both.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np

from gbspec.arrays import Array
from gbspec.backends.casadi.cvodes import FINEST, LOCAL, InitialValueProblem
from gbspec.backends.casadi.timeline import Segment, switches
from gbspec.backends.protocol import Casadi, GeneratedModule
from gbspec.diagnostics import ComputationError
from gbspec.ir import METHODS

ECHOES, MOST = 6, 400
"""So many delays after a jump steps still end where it shows again; most such times of a trajectory."""
MANY = 200_000
"""Most steps of a trajectory."""
NEAR = 1e-9
"""Share of a stretch by which a look-up prefers the piece inside the stretch, at times between two pieces."""
CLOSE, INSIDE = 1e-11, 1e-3
"""Share of the trajectory by which times are moved into a stretch where formulas jump by themselves, so that they are
not on the other side of a jump at its end; at most this share of the stretch."""


class DelaySolver:
    """Solves one instance's equations; `rhs` is its casadi.Function, with delayed values behind the inputs."""

    def __init__(self, instance: GeneratedModule, rhs: Casadi) -> None:
        self.rhs, self.equations, self.math = rhs, instance.equations, instance.arithmetic("numpy")
        self.solver = instance.solver
        self.networks = instance.numpy_networks()
        self.groups = np.array([lag for _, lag in instance.equations.delays])
        self.instance = instance

    def run(
        self,
        x0: Array,
        begin: float,
        outputs: Array,
        pieces: Sequence[Segment],
        problem: InitialValueProblem,
        step: float | None = None,
        parts: int = 1,
    ) -> tuple[Array, Array]:
        """States [n_times, n_states] at `outputs`, each before what arrives at that time, and the delayed values
        [n_times, n_delays]; the segments cover [begin, outputs[-1]]. With `step` by the module's own method in equal
        steps of at most `step`, each divided into `parts`, unchecked. Raises ComputationError."""
        return _Trajectory(self, x0, begin, outputs, pieces, problem, step, parts).run()


@dataclass(frozen=True)
class _Piece:
    """A step: its start, and the states in it."""

    begin: float
    states: Callable[[float], Array]


class _Trajectory:
    def __init__(
        self,
        solver: DelaySolver,
        x0: Array,
        begin: float,
        outputs: Array,
        pieces: Sequence[Segment],
        problem: InitialValueProblem,
        step: float | None,
        parts: int,
    ) -> None:
        self.step, self.parts = step, parts
        self.solver, self.x0, self.begin, self.outputs, self.problem = solver, x0, begin, outputs, problem
        self.segments = list(pieces)
        self.starts = [piece.begin for piece in self.segments]
        self.constants = tuple(np.float64(value) for value in problem.constants)
        found = solver.equations.lags(solver.math, problem.condition, self.constants)
        self.lags = np.array([float(lag) for lag in found])
        if not (np.isfinite(self.lags).all() and self.lags.min() > 0):
            raise ComputationError(
                f"a delay is {self.lags.min():.6g}, and it must be positive", where=f"t = {begin:.6g}"
            )
        longest = float(self.lags.max())
        self.early = switches(solver.instance, begin - longest, begin, problem.condition, self.constants)
        end = float(outputs[-1])
        scheduled = hasattr(solver.equations, "schedule")
        self.within = CLOSE * max(end - begin, abs(begin), abs(end)) if scheduled else 0.0
        self.past: list[_Piece] = []
        self.begins: list[float] = []
        self.pace: float | None = None
        self.tolerance = (
            max(LOCAL * problem.rtol, FINEST * 10),
            np.maximum(LOCAL * problem.atol, FINEST) * problem.scales,
        )

    def run(self) -> tuple[Array, Array]:
        states = np.full((len(self.outputs), len(self.x0)), np.nan)
        states[self.outputs <= self.begin] = self.x0
        late = np.array([self.late(t, t - 1.0) for t in self.outputs if t <= self.begin]).reshape(
            -1, len(self.solver.groups)
        )
        found, x = [*late], np.array(self.x0, dtype=np.float64)
        for a, b in pairwise(self._marks()):
            number = self._segment(0.5 * (a + b))
            if self.starts[number] == a:
                x = x + self.segments[number].jump
            x = self._stretch(x, a, b)
            if b in self.outputs:
                states[self.outputs == b] = x
                found.append(self.late(b, a))
        return states, np.array(found).reshape(len(self.outputs), -1)

    def _marks(self) -> list[float]:
        """The times at which steps end: outputs, changes of inputs, doses, jumps of right sides, and where these, and
        jumps of the past, show again."""
        end = float(self.outputs[-1]) if self.segments else self.begin
        span = end - self.begin
        jumps = sorted({*self.starts})
        echoes, wave = set(jumps), {*jumps, *map(float, self.early)}
        for number in range(ECHOES):
            wave = {t + lag for t in wave for lag in self.lags if t + lag < end}
            if number and len(echoes) + len(wave) > MOST + len(jumps):
                break
            echoes |= {t for t in wave if t > self.begin}
        fixed = np.array(sorted({*jumps, *(t for t in map(float, self.outputs) if t > self.begin), end}))
        loose = [t for t in echoes if np.abs(fixed - t).min() > 1e-11 * span]
        return sorted({*fixed.tolist(), *loose}) if span > 0 else []

    def _segment(self, time: float) -> int:
        return max(bisect.bisect_right(self.starts, time) - 1, 0)

    def inside(self, time: float, toward: float) -> float:
        """A time moved towards another, out of the rounding error of a jump."""
        away = toward - time
        return time + math.copysign(min(self.within, INSIDE * abs(away)), away)

    def inputs(self, time: float, toward: float) -> Array:
        """The inputs at a time, seen from the side of another; before the start those there."""
        if not self.segments:
            return np.zeros(0)
        piece = self.segments[self._segment(time + NEAR * (toward - time))]
        return piece.inputs + piece.slopes * (max(time, self.begin) - piece.begin)

    def state(self, time: float, toward: float) -> Array:
        """The state at a time not after the last piece."""
        near = time + NEAR * (toward - time)
        number = bisect.bisect_right(self.begins, near) - 1
        if number < 0 and near < self.begin:
            solver = self.solver
            found = solver.equations.history(
                solver.math, np.float64(self.inside(time, toward)), self.x0, self.problem.condition, self.constants
            )
            return np.asarray(found, dtype=np.float64)
        return self.x0 if number < 0 else self.past[number].states(time)

    def late(self, time: float, toward: float) -> Array:
        """The delayed values at a time, seen from the side of another."""
        solver, found = self.solver, np.zeros(len(self.solver.groups))
        for number, lag in enumerate(self.lags):
            s, side = time - lag, toward - lag
            x, u = self.state(s, side), self.inputs(s, side)
            values = solver.equations.delayed(
                solver.math,
                np.float64(self.inside(s, side)),
                x,
                self.problem.condition,
                u,
                self.constants,
                solver.networks,
            )
            mine = solver.groups == number
            found[mine] = np.asarray(values, dtype=np.float64)[mine]
        return found

    def _stretch(self, x: Array, a: float, b: float) -> Array:
        """The state at the end of a stretch without jumps; its steps are added to the past."""
        if self.step is not None:
            return self._fixed(x, a, b, self.step)
        from scipy.integrate import DOP853

        middle = 0.5 * (a + b)

        def rate(time: float, state: Array) -> Array:
            return self._rate(time, state, middle)

        rtol, atol = self.tolerance
        # A hair below the shortest delay, so that rounding never looks beyond the last step.
        longest = (1 - 1e-9) * float(self.lags.min())
        # A stretch begins with the step that the one before it went on with: a guess of its own is ten to a hundred
        # times too short, and the many stretches between outputs would spend most of their steps on growing it.
        first = None if self.pace is None else min(self.pace, longest, b - a)
        with np.errstate(all="ignore"):
            solver = DOP853(rate, a, x, b, max_step=longest, rtol=max(rtol, 3e-14), atol=atol, first_step=first)
            while solver.status == "running":
                begin, proposed = solver.t, solver.h_abs
                solver.step()
                if solver.status == "failed" or not np.isfinite(solver.y).all() or len(self.past) > MANY:
                    where = f"t = {solver.t:.6g}"
                    raise ComputationError("the solution cannot be continued", where=where)
                self.past.append(_Piece(begin, solver.dense_output()))
                self.begins.append(begin)
                # The last step is cut at the end of the stretch, and says little of how long it could have been.
                self.pace = max(float(proposed), float(solver.h_abs)) if solver.status == "finished" else None
        return np.asarray(solver.y, dtype=np.float64)

    def _rate(self, time: float, state: Array, toward: float) -> Array:
        """The rate of change at a time, seen from the side of another."""
        problem, inputs = self.problem, np.concatenate([self.inputs(time, toward), self.late(time, toward)])
        time = self.inside(time, toward)
        return np.array(self.solver.rhs(time, state, problem.condition, inputs, problem.constants)).ravel()

    def _fixed(self, x: Array, a: float, b: float, longest: float) -> Array:
        """The state at the end of a stretch by equal steps of the module's own method."""
        from scipy.interpolate import CubicHermiteSpline

        method = METHODS[self.solver.solver]
        count = self.parts * max(1, math.ceil((b - a) / min(longest, float(self.lags.min())) - 1e-9))
        h = (b - a) / count
        with np.errstate(all="ignore"):
            for number in range(count):
                begin = a + number * h
                slopes: list[Array] = []
                middle = begin + h / 2
                for row, c in zip(method.a[: method.advancing], method.c, strict=False):
                    ahead = sum((float(w) * k for w, k in zip(row, slopes, strict=False)), np.zeros(len(x)))
                    slopes.append(self._rate(begin + float(c) * h, x + h * ahead, middle))
                end = x + h * sum((float(w) * k for w, k in zip(method.b, slopes, strict=False)), np.zeros(len(x)))
                last = self._rate(begin + h, end, middle)
                self.past.append(_Piece(begin, CubicHermiteSpline([begin, begin + h], [x, end], [slopes[0], last])))
                self.begins.append(begin)
                x = end
        return x


def at_rest(instance: GeneratedModule, rhs: Casadi) -> Casadi:
    """casadi.Function (t, x, condition, inputs, constants) -> dx at rest: delayed values are those now."""
    t, x, c, u, k = _arguments(rhs, len(instance.inputs))
    late = _late(instance, t, x, c, u, k)
    return ca.Function("rhs", [t, x, c, u, k], [rhs(t, x, c, ca.vertcat(u, late), k)])


def linear_parts(instance: GeneratedModule, rhs: Casadi) -> Casadi | None:
    """casadi.Function (t, x, condition, inputs, constants) -> dx, the Jacobian by the state, those by the states of
    each delay side by side, and the delays; all at rest. Delays of inputs alone are left out; None if all are."""
    t, x, c, u, k = _arguments(rhs, len(instance.inputs))
    groups = [lag for _, lag in instance.equations.delays]
    late, held = ca.MX.sym("late", len(groups)), _late(instance, t, x, c, u, k)
    f = rhs(t, x, c, ca.vertcat(u, late), k)
    by_state, by_late = (ca.substitute(ca.jacobian(f, one), late, held) for one in (x, late))
    chain = ca.jacobian(held, x)
    m = instance.arithmetic("casadi")
    lags = ca.vertcat(*instance.equations.lags(m, c, m.unpack(k)))
    members = [[i for i, group in enumerate(groups) if group == lag] for lag in range(lags.shape[0])]
    parts = [ca.mtimes(by_late[:, mine], chain[mine, :]) for mine in members]
    of_states = [lag for lag, part in enumerate(parts) if part.nnz()]
    if not of_states:
        return None
    late_parts, each = ca.horzcat(*(parts[lag] for lag in of_states)), ca.vertsplit(lags)
    own_lags = ca.vertcat(*(each[lag] for lag in of_states))
    results: list[Casadi] = [ca.substitute(f, late, held), by_state, late_parts, own_lags]
    return ca.Function("parts", [t, x, c, u, k], [ca.densify(one) for one in results])


def late_at_first(instance: GeneratedModule, start: float) -> Casadi:
    """casadi.Function (t, x, condition, inputs, constants) -> delayed values at t of a trajectory from x at `start`
    with these inputs, of which nothing later than its start is known."""
    equations, m = instance.equations, instance.arithmetic("casadi")
    sizes = (
        1,
        len(instance.states),
        len(instance.conditions),
        len(instance.inputs),
        len(instance.weights["constants"]),
    )
    t, x, c, u, k = (ca.MX.sym(name, size) for name, size in zip("txcuk", sizes, strict=True))
    constants, found = m.unpack(k), []
    each = [
        equations.delayed(
            m, t - lag, ca.if_else(t - lag < start, equations.history(m, t - lag, x, c, constants), x), c, u, constants,
            instance.casadi_networks(),
        )
        for lag in equations.lags(m, c, constants)
    ]  # fmt: skip
    for i, (_, lag) in enumerate(equations.delays):
        found.append(each[lag][i])
    return ca.Function("late", [t, x, c, u, k], [ca.densify(ca.vertcat(*found))])


def _arguments(rhs: Casadi, inputs: int) -> list[Casadi]:
    sizes = [rhs.size1_in(i) for i in range(5)]
    sizes[3] = inputs
    return [ca.MX.sym(name, size) for name, size in zip("txcuk", sizes, strict=True)]


def _late(instance: GeneratedModule, t: Casadi, x: Casadi, c: Casadi, u: Casadi, k: Casadi) -> Casadi:
    m = instance.arithmetic("casadi")
    return instance.equations.delayed(m, t, x, c, u, m.unpack(k), instance.casadi_networks())
