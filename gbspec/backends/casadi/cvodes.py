"""Adaptive integration by SUNDIALS' CVODES through casadi, one segment of the trajectory's time axis at a time."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from gbspec.arrays import Array
from gbspec.backends.casadi.sliding import widened
from gbspec.backends.casadi.timeline import Segment
from gbspec.backends.protocol import Casadi
from gbspec.diagnostics import ComputationError

LOCAL = 1e-2
"""CVODES' tolerances, which bound the error of a step, relative to those requested for the whole trajectory; measured
on URP at the ignited cycle, 1e-2 keeps the global error at 10 time units below the requested tolerance."""

FINEST = 1e-14
"""The smallest local tolerance: below it, rounding would make the error control stall."""

STEPS = {"adams": 20_000, "bdf": 200_000}
"""Most steps between two outputs: beyond, Adams' methods are replaced by BDF (the problem is stiff), and BDF fails."""

KEPT = 512
"""Most integrators cached for reuse on segments with the same relative output times."""


@dataclass(frozen=True)
class InitialValueProblem:
    """The constant data of a trajectory; states are divided by `scales` [n_states] inside the integrator."""

    condition: Array
    constants: Array
    scales: Array
    rtol: float
    atol: float


Explain = Callable[[float, Array, Array, InitialValueProblem], str]


class _Stopped(Exception):  # noqa: N818 - an event, not an error
    """CVODES could not reach the end of a segment."""


class Integrator:
    """Integrates one right-hand side: casadi.Function (t, x, condition, inputs, constants) -> dx.

    Within a segment, time runs from 0 to 1 and states are divided by their scales, so that one integrator serves all
    segments with the same relative output times, and one absolute tolerance serves all states. `explain` says in words
    what has no value at a time, a state and inputs. Where no step ends, switches of the right-hand side get a width, if
    solutions may slide along them (`slides`).
    """

    def __init__(self, rhs: Casadi, names: Sequence[str], explain: Explain | None = None, slides: bool = True) -> None:
        self._names, self._explain, self._may_slide = tuple(names), explain, slides
        self._rhs, self._system = rhs, _scaled(rhs)
        self._kept: OrderedDict[tuple[tuple[float, ...], float, float, bool, bool], Casadi] = OrderedDict()
        self._stiff = self._slides = False

    @cached_property
    def _widened(self) -> Casadi | None:
        """The system with a width of its switches; None if it has none."""
        found = widened(self._rhs) if self._may_slide else None
        return None if found is None else _scaled(found)

    def run(
        self, x0: Array, begin: float, outputs: Array, pieces: Sequence[Segment], problem: InitialValueProblem
    ) -> Array:
        """States [n_times, n_states] at `outputs`; the segments cover [begin, outputs[-1]]."""
        states = np.empty((len(outputs), len(x0)))
        states[outputs <= begin] = x0
        self._slides = False
        self._check(x0, begin)
        x = x0
        for piece in pieces:
            x = x + piece.jump
            inside = (outputs > piece.begin) & (outputs <= piece.end)
            times = outputs[inside]
            if not len(times) or times[-1] != piece.end:
                times = np.append(times, piece.end)
            found = self._piece(x, piece, times, problem)
            states[inside] = found[: int(np.sum(inside))]
            x = found[-1]
        return states

    def _piece(self, x: Array, piece: Segment, times: Array, problem: InitialValueProblem) -> Array:
        """States [n, n_states] at `times` in a segment; the last of these times is its end."""
        # Adams' methods take many steps where a problem is stiff; BDF does not, and is used from then on. A solution
        # that slides along a switch may do so in the next segment of its trajectory too.
        ways = [(True, True)] if self._slides else [(self._stiff, False), (True, False), (True, True)]
        for stiff, slides in dict.fromkeys(ways):
            if slides and self._widened is None:
                break
            try:
                found = self._solve(x, piece, times, problem, stiff, slides)
            except _Stopped:
                continue
            self._stiff, self._slides = self._stiff or (stiff and not slides), slides
            return found
        raise self._failure(x, piece, times, problem)

    def _solve(
        self, x: Array, piece: Segment, times: Array, problem: InitialValueProblem, stiff: bool, slides: bool = False
    ) -> Array:
        """States at `times`. Raises `_Stopped` if CVODES fails or a state is not finite."""
        length = piece.end - piece.begin
        grid = (*((times - piece.begin) / length).tolist()[:-1], 1.0)
        solver = self._solver(grid, problem, stiff, slides)
        scales = problem.scales
        within = [piece.begin + piece.insets[0], length - sum(piece.insets)]
        parameters = np.concatenate((within, problem.condition, piece.inputs, piece.slopes, problem.constants, scales))
        try:
            found = np.array(solver(x0=x / scales, p=parameters)["xf"]).T * scales
        except RuntimeError as error:
            raise _Stopped from error
        if not np.all(np.isfinite(found)):
            raise _Stopped
        return found

    def _solver(self, grid: tuple[float, ...], problem: InitialValueProblem, stiff: bool, slides: bool) -> Casadi:
        key = (grid, problem.rtol, problem.atol, stiff, slides)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        method = "bdf" if stiff else "adams"
        options: dict[str, float | str | bool] = {
            "reltol": max(problem.rtol * LOCAL, FINEST),
            "abstol": max(problem.atol * LOCAL, FINEST),
            "linear_multistep_method": method,
            "max_num_steps": STEPS[method],
            "show_eval_warnings": False,
            "disable_internal_warnings": True,
        }
        system = self._widened if slides and self._widened is not None else self._system
        self._kept[key] = ca.integrator("trajectory", "cvodes", system, 0, list(grid), options)
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return self._kept[key]

    def _failure(self, x: Array, piece: Segment, times: Array, problem: InitialValueProblem) -> ComputationError:
        """The error for a segment that cannot be integrated; it says how far the solution reaches."""
        last = piece.begin
        for time in times:
            part = Segment(last, float(time), _inputs_at(piece, last), piece.slopes, np.zeros_like(x))
            try:
                x = self._solve(x, part, np.array([time]), problem, stiff=True)[-1]
            except _Stopped:
                break
            last = float(time)
        why = "" if self._explain is None else self._explain(last, x, _inputs_at(piece, last), problem)
        return ComputationError(
            "the trajectory cannot be integrated further: "
            + (why or "it blows up, or the right-hand side is not finite there, or jumps"),
            where=f"after t = {last:.6g}, where {self._state(x)}",
            remedy="change the initial state, shorten the span, or exclude the region (simulate: --reject, --initial)",
        )

    def _check(self, x: Array, time: float) -> None:
        if not np.all(np.isfinite(x)):
            raise ComputationError(
                "the initial state of a trajectory is not finite",
                where=f"at t = {time:.6g}, where {self._state(x)}",
                remedy="give every state an initial value",
            )

    def _state(self, x: Array) -> str:
        return ", ".join(f"{name} = {value:.6g}" for name, value in zip(self._names, x, strict=True))


def _inputs_at(piece: Segment, time: float) -> Array:
    return np.asarray(piece.inputs + piece.slopes * (time - piece.begin), dtype=np.float64)


def _scaled(rhs: Casadi) -> Casadi:
    """The system in scaled time and states, of a right-hand side that may take the scales too.

    Its parameters are begin, length, condition, inputs, slopes, constants and scales.
    The right-hand side is written out in it: the derivative of a call by the states has terms with those by all other
    arguments, and log(x) of a power x^n times zero is not a number where x is negative.
    """
    kind: Casadi = ca.SX if rhs.is_a("SXFunction") else ca.MX
    n_states, n_condition, n_inputs, n_constants = (rhs.size1_in(i) for i in (1, 2, 3, 4))
    sizes = [1, 1, n_condition, n_inputs, n_inputs, n_constants, n_states]
    tau, y, z, u = kind.sym("tau"), kind.sym("y", n_states), kind.sym("z", 0), kind.sym("u", 0)
    p = kind.sym("p", sum(sizes))
    begin, length, condition, inputs, slopes, constants, scales = ca.vertsplit(p, np.cumsum([0, *sizes]).tolist())
    elapsed = length * tau
    given = [begin + elapsed, scales * y, condition, inputs + slopes * elapsed, constants, scales]
    (dx,) = rhs.call(given[: rhs.n_in()], True, False)
    empty = kind(0, 1)
    return ca.Function(
        "system",
        [tau, y, z, p, u],
        [ca.densify(length * dx / scales), empty, empty, empty],
        ["t", "x", "z", "p", "u"],
        ["ode", "alg", "quad", "zero"],
    )
