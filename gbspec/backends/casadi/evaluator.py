"""Evaluation of a model by casadi, for analysis and simulation; truths and fitted models use the same functions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from gbspec.arrays import Array
from gbspec.backends.casadi import steps
from gbspec.backends.casadi.cvodes import InitialValueProblem, Integrator
from gbspec.backends.casadi.delays import DelaySolver, at_rest, late_at_first, linear_parts
from gbspec.backends.casadi.events import EventSolver
from gbspec.backends.casadi.starts import Course as Course
from gbspec.backends.casadi.starts import first_values, steady_start
from gbspec.backends.casadi.timeline import Jump, Segment, Signal, at_rows, segments, switches
from gbspec.backends.protocol import Casadi, GeneratedModule
from gbspec.diagnostics import ComputationError
from gbspec.ir import METHODS


class Events(Protocol):
    """The doses of one kind: amounts [n] at times [n]."""

    @property
    def times(self) -> Array:
        """When."""

    @property
    def amounts(self) -> Array:
        """How much."""


NOTHING = 1e-100
"""An initial value that gives no scale: what is left of a state that has decayed."""
MAPS = 64
"""Most mapped functions that an evaluator caches, each for a given number of points."""


class Evaluator:
    """Functions of an instance of a generated module, which has weights unless its model has no unknown functions.

    `rhs`, `jacobian` and `observe` are casadi Functions of (t, x, condition, inputs, constants); `constants` is the
    vector of the instance's own constants, the default of every `constants` argument.
    """

    def __init__(self, instance: GeneratedModule) -> None:
        self.instance = instance
        self.n_states = len(instance.states)
        self.n_conditions, self.n_inputs = len(instance.conditions), len(instance.inputs)
        self.constants: Array = np.array(instance.weights["constants"], dtype=np.float64)
        self._maps: dict[tuple[str, int], Casadi] = {}
        self._unknowns: dict[str, Casadi] = {}

    # -------------------------------------------------------------- casadi functions
    @cached_property
    def rhs(self) -> Casadi:
        """casadi.Function (t, x, condition, inputs, constants) -> dx [n_states]."""
        return self.instance.casadi_rhs(symbolic_constants=True)

    @cached_property
    def jacobian(self) -> Casadi:
        """casadi.Function (t, x, condition, inputs, constants) -> d(dx)/dx [n_states, n_states]."""
        return self.instance.casadi_jacobian(symbolic_constants=True)

    @cached_property
    def observe(self) -> Casadi:
        """casadi.Function (t, x, condition, inputs, constants) -> y [n_channels]."""
        return self.instance.casadi_observe(symbolic_constants=True)

    def function(self, name: str) -> Casadi:
        """casadi.Function (arguments, constants) -> value of one unknown. Raises KeyError for another name."""
        if name not in self._unknowns:
            self._unknowns[name] = self.instance.casadi_function(name, symbolic_constants=True)
        return self._unknowns[name]

    # -------------------------------------------------------------- over many points
    def rhs_many(
        self,
        t: ArrayLike,
        x: ArrayLike,
        condition: ArrayLike = (),
        inputs: ArrayLike = (),
        constants: ArrayLike | None = None,
    ) -> Array:
        """dx/dt [N, n_states] at times t ([N] or a number), states x [N, n_states]; the rest [N, n], or [n] for all."""
        return self._many("rhs", self.rhs, self._points(t, x, condition, inputs, constants))

    def observe_many(
        self,
        t: ArrayLike,
        x: ArrayLike,
        condition: ArrayLike = (),
        inputs: ArrayLike = (),
        constants: ArrayLike | None = None,
    ) -> Array:
        """Channels [N, n_channels]; arguments as for `rhs_many`."""
        return self._many("observe", self.observe, self._points(t, x, condition, inputs, constants))

    def algebraics_many(self, t: ArrayLike, x: ArrayLike, condition: ArrayLike = (), inputs: ArrayLike = ()) -> Array:
        """Algebraic variables [N, n]; arguments as for `rhs_many`."""
        columns = self._points(t, x, condition, inputs, None)[:-1]
        count = max(len(column) for column in columns)
        time, state, known, given = (np.broadcast_to(column, (count, column.shape[1])) for column in columns)
        m, networks = self.instance.arithmetic("numpy"), self.instance.numpy_networks()
        found = self.instance.equations.algebraic(m, time[:, 0], state, known, given, self._tuple(None), networks)
        return np.asarray(found, dtype=np.float64)

    def functions_many(self, name: str, arguments: ArrayLike, constants: ArrayLike | None = None) -> Array:
        """Values [N] of an unknown at arguments [N, n_arguments]."""
        table = np.atleast_2d(np.asarray(arguments, dtype=np.float64))
        return self._many(f"function {name}", self.function(name), [table, self._constants(constants)])[:, 0]

    def jacobian_at(
        self,
        t: float,
        x: ArrayLike,
        condition: ArrayLike = (),
        inputs: ArrayLike = (),
        constants: ArrayLike | None = None,
    ) -> Array:
        """d(dx/dt)/dx [n_states, n_states] at one point."""
        self._require_past(inputs)
        return np.array(self.jacobian(t, x, condition, inputs, self._constants(constants)))

    def initial(
        self,
        x0: ArrayLike,
        condition: ArrayLike = (),
        constants: ArrayLike | None = None,
        inputs: Sequence[Course] = (),
        at: float | None = None,
    ) -> Array:
        """The initial state [n_states]: x0, with the initial values that the model gives replaced.

        `inputs` and `at`, the time of the start, matter to steady starts alone. Raises ComputationError without one.
        """
        m, given = self.instance.arithmetic("numpy"), np.asarray(condition, dtype=np.float64)
        with np.errstate(all="ignore"):
            start = self.instance.equations.initial(m, np.asarray(x0, dtype=np.float64), given, self._tuple(constants))
        start = np.array(start, dtype=np.float64)
        if not hasattr(self.instance.equations, "steady"):
            return start
        first = first_values(self.instance, inputs, at)
        known = np.array(self._tuple(constants), dtype=np.float64)
        return steady_start(self.instance, (self.rhs, self.jacobian), start, given, first, known)

    def _points(
        self, t: ArrayLike, x: ArrayLike, condition: ArrayLike, inputs: ArrayLike, constants: ArrayLike | None
    ) -> list[Array]:
        state = np.asarray(x, dtype=np.float64).reshape(-1, self.n_states)
        time = np.asarray(t, dtype=np.float64).reshape(-1, 1)
        self._require_past(inputs)
        width = self.n_inputs + (len(self.instance.equations.delays) if self.has_delays else 0)
        return [
            time,
            state,
            np.asarray(condition, dtype=np.float64).reshape(-1, self.n_conditions)
            if self.n_conditions
            else np.zeros((1, 0)),
            np.asarray(inputs, dtype=np.float64).reshape(-1, width) if width else np.zeros((1, 0)),
            self._constants(constants),
        ]

    def _require_past(self, inputs: ArrayLike) -> None:
        """Raises ComputationError if a model with delays gets declared inputs alone."""
        width = self.n_inputs + (len(self.instance.equations.delays) if self.has_delays else 0)
        if self.has_delays and np.shape(inputs)[-1:] != (width,):
            what = "the equations of a model with delays depend on the past, not on a state alone"
            raise ComputationError(what, where="a point without a past", remedy="compare solutions instead")

    def _many(self, key: str, function: Casadi, columns: Sequence[Array]) -> Array:
        """A function at N points, in one call; a single row is used for all points."""
        tables = [np.atleast_2d(column) for column in columns]
        count = max(len(table) for table in tables)
        if (key, count) not in self._maps:
            if len(self._maps) >= MAPS:
                self._maps.clear()
            self._maps[key, count] = function.map(count)
        blocks = [np.ascontiguousarray(np.broadcast_to(table, (count, table.shape[1])).T) for table in tables]
        return np.ascontiguousarray(np.array(self._maps[key, count](*blocks)).T)

    def _constants(self, constants: ArrayLike | None) -> Array:
        return self.constants if constants is None else np.asarray(constants, dtype=np.float64)

    def _tuple(self, constants: ArrayLike | None) -> tuple[np.float64, ...]:
        return tuple(np.float64(value) for value in self._constants(constants))

    # -------------------------------------------------------------- over time
    def integrate(
        self,
        x0: ArrayLike,
        times: ArrayLike,
        condition: ArrayLike = (),
        inputs: Sequence[Course] = (),
        start: float | None = None,
        *,
        doses: Sequence[Events] = (),
        constants: ArrayLike | None = None,
        rtol: float = 1e-10,
        atol: float = 1e-10,
        scales: ArrayLike | None = None,
    ) -> Array:
        """States [n_times, n_states] at increasing `times`, from x0 [n_states] at `start` (default: the first time).

        Uses CVODES, with variable order and step, restarted wherever the slope of an input changes or a dose is given,
        so that no step crosses a kink. `inputs` are signals with `times` and `values`, one per input; `doses` have
        `times` and `amounts`, one per declared dose, added after a measurement at the same time. Errors are kept below
        rtol relative to the state and atol relative to `scales` [n_states] (default: from the states' ranges, else
        from x0). Both hold for the whole trajectory: CVODES' own, local tolerances are a hundred times tighter.

        Raises ComputationError, with time and state, if the solution cannot be continued or is not finite.
        """
        return self.followed(
            x0, times, condition, inputs, start, doses=doses, constants=constants, rtol=rtol, atol=atol, scales=scales
        )[0]

    def followed(
        self,
        x0: ArrayLike,
        times: ArrayLike,
        condition: ArrayLike = (),
        inputs: Sequence[Course] = (),
        start: float | None = None,
        *,
        doses: Sequence[Events] = (),
        constants: ArrayLike | None = None,
        rtol: float = 1e-10,
        atol: float = 1e-10,
        scales: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """States as from `integrate`, and the delayed values [n_times, n_delays], which `rhs` and `observe` take behind
        the inputs."""
        outputs = self._times(times, start)
        begin = float(outputs[0]) if start is None else float(start)
        pieces = self._segments(begin, outputs, condition, inputs, doses, constants)
        nominal = self._scales(x0) if scales is None else np.asarray(scales, dtype=np.float64)
        problem = InitialValueProblem(
            np.asarray(condition, dtype=np.float64).ravel(), self._constants(constants), nominal, rtol, atol
        )
        if self.has_delays:
            solver = DelaySolver(self.instance, self.rhs)
            return solver.run(np.asarray(x0, dtype=np.float64), begin, outputs, pieces, problem)
        none = np.zeros((len(outputs), 0))
        return self._followed(np.asarray(x0, dtype=np.float64), begin, outputs, pieces, problem), none

    def _followed(
        self, x0: Array, begin: float, outputs: Array, pieces: Sequence[Segment], problem: InitialValueProblem
    ) -> Array:
        if self.has_events:
            return self._event_solver.run(x0, begin, outputs, pieces, problem)
        return self._integrator.run(x0, begin, outputs, pieces, problem)

    def integrate_fixed(
        self,
        x0: ArrayLike,
        times: ArrayLike,
        condition: ArrayLike = (),
        inputs: Sequence[Course] = (),
        start: float | None = None,
        *,
        max_step: float,
        doses: Sequence[Events] = (),
        constants: ArrayLike | None = None,
        parts: int = 1,
    ) -> Array:
        """States as from `integrate`, by the module's own method in equal steps of at most `max_step` between outputs
        and kinks, each divided into `parts`.

        States may be infinite or NaN: the fixed step is not checked. With events the steps are adaptive here too.
        """
        return self.followed_fixed(
            x0, times, condition, inputs, start, max_step=max_step, doses=doses, constants=constants, parts=parts
        )[0]

    def followed_fixed(
        self,
        x0: ArrayLike,
        times: ArrayLike,
        condition: ArrayLike = (),
        inputs: Sequence[Course] = (),
        start: float | None = None,
        *,
        max_step: float,
        doses: Sequence[Events] = (),
        constants: ArrayLike | None = None,
        parts: int = 1,
    ) -> tuple[Array, Array]:
        """States as from `integrate_fixed`, and the delayed values [n_times, n_delays]."""
        if self.has_events:
            return self.followed(x0, times, condition, inputs, start, doses=doses, constants=constants)
        if self.has_delays:
            outputs = self._times(times, start)
            begin = float(outputs[0]) if start is None else float(start)
            pieces = self._segments(begin, outputs, condition, inputs, doses, constants)
            given, nominal = np.asarray(condition, dtype=np.float64).ravel(), np.ones(self.n_states)
            problem = InitialValueProblem(given, self._constants(constants), nominal, 0.0, 0.0)
            solver, start_state = DelaySolver(self.instance, self.rhs), np.asarray(x0, dtype=np.float64)
            return solver.run(start_state, begin, outputs, pieces, problem, max_step, parts)
        plan = self.plan(
            times, condition, inputs, start, max_step=max_step, doses=doses, constants=constants, parts=parts
        )
        return self.by_plan(x0, plan, condition, constants), np.zeros((len(plan.after), 0))

    def plan(
        self,
        times: ArrayLike,
        condition: ArrayLike = (),
        inputs: Sequence[Course] = (),
        start: float | None = None,
        *,
        max_step: float,
        doses: Sequence[Events] = (),
        constants: ArrayLike | None = None,
        parts: int = 1,
    ) -> steps.StepPlan:
        """The steps of `integrate_fixed`, of a model without events and delays. They do not depend on the initial
        state, and on constants only through doses and times at which right-hand sides switch."""
        outputs = self._times(times, start)
        begin = float(outputs[0]) if start is None else float(start)
        pieces = self._segments(begin, outputs, condition, inputs, doses, constants)
        sizes = (self.n_states, self.n_inputs)
        return steps.plan(begin, outputs, pieces, max_step, *sizes, METHODS[self.instance.solver], parts)

    def by_plan(
        self, x0: ArrayLike, plan: steps.StepPlan, condition: ArrayLike = (), constants: ArrayLike | None = None
    ) -> Array:
        """States [n_times, n_states] at the outputs of a plan; they may be infinite or NaN."""
        given = np.asarray(condition, dtype=np.float64).ravel()
        return self._stepper.run(np.asarray(x0, dtype=np.float64), plan, given, self._constants(constants))

    @cached_property
    def _integrator(self) -> Integrator:
        solves = hasattr(self.instance.equations, "blocks")
        return Integrator(self.rhs, tuple(self.instance.states), self._unsolved if solves else None, not solves)

    def _unsolved(self, t: float, x: Array, inputs: Array, problem: InitialValueProblem) -> str:
        """Which algebraic equations have no solution at a state or shortly after it, in words; empty for none."""
        m, networks = self.instance.arithmetic("numpy"), self.instance.numpy_networks()
        constants = self._tuple(problem.constants)
        slope = np.array(self.rhs(t, x, problem.condition, inputs, problem.constants)).ravel()
        steepest = float(np.abs(slope).max(initial=0.0))
        reach = float(problem.scales.max()) / steepest if 0.0 < steepest < np.inf else 0.0
        for share in (0.0, 1e-4, 1e-2, 0.1, 0.3, 1.0, 3.0):
            at = x + share * reach * slope if share else x
            given = (t, at, problem.condition, inputs, constants, networks)
            if text := self.instance.equations.unsolved(m, *given):
                return text
        return ""

    @property
    def has_events(self) -> bool:
        """Whether its model has events."""
        return hasattr(self.instance.equations, "events")

    @property
    def has_delays(self) -> bool:
        """Whether its model has delays."""
        return hasattr(self.instance.equations, "delays")

    @cached_property
    def at_rest(self) -> Casadi:
        """`rhs` of declared inputs alone: of a model with delays, where nothing changes."""
        return at_rest(self.instance, self.rhs) if self.has_delays else self.rhs

    def late_at_first(self, start: float) -> Casadi:
        """Delayed values of a trajectory of which nothing later than its start is known (`delays.late_at_first`)."""
        return late_at_first(self.instance, start)

    @cached_property
    def linear_parts(self) -> Casadi | None:
        """What characteristic roots at rest are computed from (`delays.linear_parts`); None if no state is delayed."""
        return linear_parts(self.instance, self.rhs) if self.has_delays else None

    @cached_property
    def _event_solver(self) -> EventSolver:
        return EventSolver(self.instance, self.rhs, self.jacobian)

    @cached_property
    def _stepper(self) -> steps.Stepper:
        return steps.Stepper(self.instance)

    def _times(self, times: ArrayLike, start: float | None) -> Array:
        outputs = np.asarray(times, dtype=np.float64).ravel()
        if not len(outputs) or not np.all(np.isfinite(outputs)) or np.any(np.diff(outputs) <= 0):
            raise ValueError("times must be finite and must increase, and at least one is needed")
        if start is not None and outputs[0] < start:
            raise ValueError(f"the first time, {outputs[0]}, lies before the start, {start}")
        return outputs

    def _segments(
        self,
        begin: float,
        outputs: Array,
        condition: ArrayLike,
        inputs: Sequence[Course],
        doses: Sequence[Events],
        constants: ArrayLike | None,
    ) -> list[Segment]:
        if len(inputs) != self.n_inputs:
            raise ValueError(f"the model has {self.n_inputs} inputs, {len(inputs)} were given")
        signals = [
            Signal(np.asarray(item.times, dtype=np.float64), np.asarray(item.values, dtype=np.float64))
            for item in inputs
        ]
        jumps = at_rows(self._jumps(condition, doses, constants), begin, outputs)
        end, kinds = float(outputs[-1]), self.instance.interpolation
        switches = self._switches(begin, end, condition, constants)
        return segments(begin, end, self.n_states, signals, kinds, jumps, switches, outputs)

    def _switches(self, begin: float, end: float, condition: ArrayLike, constants: ArrayLike | None) -> Array:
        """The times at which right sides jump, as far as they follow from the time alone."""
        known = (np.asarray(condition, dtype=np.float64).ravel(), self._tuple(constants))
        return switches(self.instance, begin, end, *known)

    def _jumps(self, condition: ArrayLike, doses: Sequence[Events], constants: ArrayLike | None) -> list[Jump]:
        if not doses:
            return []
        names = self.instance.doses
        if len(doses) != len(names):
            raise ValueError(f"the model declares {len(names)} doses, {len(doses)} were given")
        m = self.instance.arithmetic("numpy")
        terms = self.instance.equations.doses(
            m, np.asarray(condition, dtype=np.float64).ravel(), self._tuple(constants)
        )
        return [
            Jump(float(time) + float(lag), self.instance.states.index(name), float(amount) * float(fraction))
            for name, events, (fraction, lag) in zip(names, doses, terms, strict=True)
            for time, amount in zip(events.times, events.amounts, strict=True)
        ]

    def _scales(self, x0: ArrayLike) -> Array:
        """The scale of each state: from its range if it is bounded, else from its initial value; 1 if both are zero.

        A remainder such as 5e-151 counts as zero: in units of it, products and squares overflow inside CVODES.
        """
        scales = np.abs(np.asarray(x0, dtype=np.float64)).ravel().copy()
        for i, name in enumerate(self.instance.states):
            size = max(map(abs, self.instance.ranges.get(name, (0.0,))))
            if 0 < size < np.inf:
                scales[i] = size
        return np.where(scales > NOTHING, scales, 1.0)
