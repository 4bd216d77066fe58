"""A dynamical system to analyse: a CasADi right-hand side with the names and values of its parameters.

A `System` is made from an evaluator (of a fitted run or of a model's truth) or directly from a casadi.Function, so that
all analyses treat these in the same way. A `Family` is a system with one varying parameter.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.systems.compiled import Compiled
from gbspec.analysis.systems.fence import Extrapolation
from gbspec.analysis.systems.roots import characteristic_modes, ordered_eigenvalues, ordered_modes
from gbspec.arrays import Array, ComplexArray
from gbspec.backends import Casadi
from gbspec.data import Interpolation, Signal, evaluate
from gbspec.diagnostics import Findings

if TYPE_CHECKING:
    from gbspec.backends import Evaluator, GeneratedModule
    from gbspec.ir import Condition, Input, Model, Range, State

Box = tuple[float, float]
ANYTHING: Box = (-math.inf, math.inf)


@dataclass(frozen=True)
class System:
    """x' = rhs(t, x, c, u, k) with states x, conditions c, inputs u and constants k.

    `rhs` is a casadi.Function of these five columns. By name, `values` holds the known values of conditions, inputs and
    constants (others must be given with a point), `ranges` the plausible or trained ranges of states, conditions and
    inputs, of which those in `declared` are the user's; `trained` the ranges of the training data, and `starts` guesses
    of initial values. `interpolation` is that of each input; `extrapolation` says where functions are far from their
    data, None if that is not known. With delays `rhs` is that at rest, and `delayed` what characteristic roots are
    computed from (`Evaluator.linear_parts`).
    """

    name: str
    states: tuple[str, ...]
    rhs: Casadi = field(repr=False)
    conditions: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    interpolation: tuple[Interpolation, ...] = ()
    constants: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    ranges: Mapping[str, Box] = field(default_factory=dict)
    declared: frozenset[str] = frozenset()
    trained: Mapping[str, Box] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)
    time: float = 0.0
    extrapolation: Extrapolation | None = field(default=None, repr=False)
    delayed: Casadi | None = field(default=None, repr=False)

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of all parameters: conditions, inputs, constants."""
        return (*self.conditions, *self.inputs, *self.constants)

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.states)

    def range(self, name: str) -> Box:
        """The range of a name; infinite if unknown."""
        return self.ranges.get(name, ANYTHING)

    def with_values(self, values: Mapping[str, float]) -> System:
        """The same system with other values of some conditions, inputs or constants."""
        return replace(self, values={**self.values, **{name: float(value) for name, value in values.items()}})

    def outside(self, x: Array) -> tuple[str, ...]:
        """What is outside at a state [n], or anywhere along states [R, n]: see `gbspec.analysis.systems.fence`.

        Functions that are extrapolated, after the states, conditions and inputs outside their trained (else plausible)
        ranges. Where it is known how far the data lie, leaving a trained range alone does not count.
        """
        states = np.atleast_2d(x)
        numbers: dict[str, Array | float] = {**self.values, **dict(zip(self.states, states.T, strict=True))}
        far = self._extrapolated(states)
        names = [
            name
            for name in (*self.states, *self.conditions, *self.inputs)
            if name in numbers
            and not (far == () and name in self.trained)
            and any(not _inside(float(v), self.trained.get(name, self.range(name))) for v in np.ravel(numbers[name]))
        ]
        return (*names, *(far or ()))

    def _extrapolated(self, states: Array) -> tuple[str, ...] | None:
        """The functions extrapolated anywhere along states [R, n]; None if that is not known."""
        if self.extrapolation is None or self.missing:
            return None
        values = (self.vector(names) for names in (self.conditions, self.inputs, self.constants))
        found = self.extrapolation.functions(self.time, states, *values)
        return tuple(name for name, far in found.items() if far.any())

    def admissible(self, x: Array) -> bool:
        """Whether no state is below a declared lower bound that is zero or more (a concentration below zero)."""
        for name, value in zip(self.states, map(float, x), strict=True):
            low, high = self.range(name)
            if name in self.declared and low >= 0.0 and value < low and not _inside(value, (low, high)):
                return False
        return True

    @cached_property
    def start_box(self) -> tuple[Array, Array]:
        """Lower and upper ends [n] of the box of initial guesses: the ranges, else around the guesses."""
        ends = []
        for name in self.states:
            low, high = self.range(name)
            guess = self.starts.get(name, 0.0)
            reach = 10.0 * max(1.0, abs(guess))
            ends.append(
                (
                    low if math.isfinite(low) else min(guess, high) - reach,
                    high if math.isfinite(high) else max(guess, low) + reach,
                )
            )
        box = np.array(ends, dtype=float)
        return box[:, 0], box[:, 1]

    @property
    def scale(self) -> Array:
        """The scale [n] of the states: the width of the box of initial guesses."""
        low, high = self.start_box
        return np.where(high > low, high - low, 1.0)

    def symbolic_rhs(self, varied: Mapping[str, Casadi]) -> tuple[Casadi, Casadi]:
        """MX symbols x and f(x), with `varied` substituted for some parameters and numbers for all others."""
        import casadi

        x = casadi.MX.sym("x", self.size)

        def column(names: tuple[str, ...]) -> Casadi:
            values = [varied[name] if name in varied else casadi.MX(self.values[name]) for name in names]
            return casadi.vertcat(*values) if values else casadi.MX(0, 1)

        arguments = (column(self.conditions), column(self.inputs), column(self.constants))
        return x, self.rhs(casadi.MX(self.time), x, *arguments)

    @property
    def missing(self) -> tuple[str, ...]:
        """Conditions, inputs and constants without a value."""
        return tuple(name for name in self.parameters if not math.isfinite(self.values.get(name, math.nan)))

    def vector(self, names: Iterable[str]) -> Array:
        """The values of these names, in order; NaN for a name without one."""
        return np.array([self.values.get(name, math.nan) for name in names], dtype=float)

    def inputs_at(self, signals: Sequence[Signal], time: float) -> dict[str, float]:
        """The inputs' values at a time of a trajectory with these signals, one per input."""
        return {
            name: float(evaluate(signal, interpolation, time))
            for name, signal, interpolation in zip(self.inputs, signals, self.interpolation, strict=True)
        }

    @cached_property
    def depends_on_time(self) -> bool:
        """Whether the right-hand side depends on time explicitly."""
        return int(self.rhs.jac_sparsity(0, 0).nnz()) > 0

    @cached_property
    def linearised(self) -> Compiled:
        """(t, x, c, u, k) -> rhs [n], d(rhs)/dx [n, n]."""
        import casadi

        t, x, c, u, k = (casadi.MX.sym(name, self.rhs.size1_in(i)) for i, name in enumerate("txcuk"))
        f = self.rhs(t, x, c, u, k)
        return Compiled(casadi.Function("linearised", [t, x, c, u, k], [f, casadi.jacobian(f, x)]))

    def linearise(self, x: Array, time: float | None = None) -> tuple[Array, Array]:
        """The right-hand side [n] and its Jacobian [n, n] at state `x` [n], with all parameters at `values`."""
        f, jacobian = self.linearised(
            self.time if time is None else time,
            x,
            self.vector(self.conditions),
            self.vector(self.inputs),
            self.vector(self.constants),
        )
        return f, jacobian.reshape(self.size, self.size)

    @cached_property
    def _delayed(self) -> Compiled:
        return Compiled(self.delayed)

    def modes(self, x: Array, time: float | None = None) -> tuple[ComplexArray, ComplexArray]:
        """The eigenvalues at state `x` [n], by decreasing real part, and the eigenvectors with states in units of their
        scales, unit columns; with delays the rightmost characteristic roots, where `x` is at rest."""
        scale = self.scale
        if self.delayed is None:
            return ordered_modes(self.linearise(x, time)[1] * scale / scale[:, None])
        arguments = (self.vector(names) for names in (self.conditions, self.inputs, self.constants))
        _, now, late, lags = self._delayed(self.time if time is None else time, x, *arguments)
        n = self.size
        parts = [now.reshape(n, n), *np.split(late.reshape(n, -1), len(lags), axis=1)]
        first, *others = (part * scale / scale[:, None] for part in parts)
        return characteristic_modes(first, others, lags)

    def spectrum(self, x: Array, time: float | None = None) -> ComplexArray:
        """The eigenvalues at state `x` [n], by decreasing real part; with delays as in `modes`."""
        return ordered_eigenvalues(self.linearise(x, time)[1]) if self.delayed is None else self.modes(x, time)[0]


def system_of(evaluator: Evaluator, model: Model, extrapolation: Extrapolation | None = None) -> System:
    """The system of an evaluator: constants from its module, ranges as declared, else as trained."""
    module = evaluator.instance
    values: dict[str, float] = {}
    external: tuple[Condition | Input, ...] = (*model.conditions, *model.inputs)
    values.update({item.name: float(item.default) for item in external if item.default is not None})
    values.update(zip(model.constant_names, map(float, evaluator.constants), strict=True))
    ranged: tuple[State | Condition | Input, ...] = (*model.states, *external)
    declared = {item.name: _box(item.range) for item in ranged if item.range is not None}
    trained = trained_ranges(model, module)
    return System(
        name=model.name,
        states=tuple(state.name for state in model.states),
        rhs=evaluator.at_rest,
        conditions=tuple(condition.name for condition in model.conditions),
        inputs=tuple(item.name for item in model.inputs),
        interpolation=tuple(item.interpolation for item in model.inputs),
        constants=model.constant_names,
        values=values,
        ranges={**trained, **declared},
        declared=frozenset(declared),
        trained=trained,
        starts={state.name: float(state.start) for state in model.states if state.start is not None},
        time=model.time.start or 0.0,
        extrapolation=extrapolation,
        delayed=evaluator.linear_parts,
    )


def _box(declared: Range) -> Box:
    return float(declared.low), float(declared.high)


def _inside(value: float, box: Box) -> bool:
    """Whether a number is in an interval, up to rounding."""
    low, high = box
    slack = 1e-6 * (high - low if math.isfinite(high - low) else max(1.0, abs(value)))
    return low - slack <= value <= high + slack


def trained_ranges(model: Model, module: GeneratedModule) -> dict[str, Box]:
    """The ranges of the training data, stored with the weights, for each name that is an argument of an unknown."""
    import sympy

    from gbspec.ir import right_sides

    applications = {
        one.func.__name__: one
        for expression in right_sides(model)
        for one in expression.atoms(sympy.core.function.AppliedUndef)
    }
    ranges: dict[str, Box] = {}
    for network in model.networks:
        lows, highs = (module.weights.get(f"network.{network.name}.input_{end}") for end in ("low", "high"))
        for output in network.outputs:
            if output in applications and lows is not None and highs is not None:
                for argument, low, high in zip(applications[output].args, lows, highs, strict=True):
                    if argument.is_Symbol:
                        known = ranges.get(argument.name, (math.inf, -math.inf))
                        ranges[argument.name] = min(known[0], float(low)), max(known[1], float(high))
    return ranges


def suggestion(name: str, names: Iterable[str]) -> str:
    """A help line for an unknown name: the closest existing one, or all."""
    names = list(names)
    close = difflib.get_close_matches(name, names, n=1)
    if close:
        return f"did you mean `{close[0]}`?"
    return "it has " + ", ".join(f"`{known}`" for known in names) if names else ""


def state_at(system: System, point: Mapping[str, float], findings: Findings) -> tuple[System, Array] | None:
    """A point given by names: the system with the point's conditions, inputs and constants, and the state [n].

    Every state must be given, and every condition or input without a default; constants may be. Returns None after
    errors, which go to `findings` (GB870 for an unknown name, GB871 for a missing one).
    """
    known = (*system.states, *system.parameters)
    unknown = [name for name in point if name not in known]
    for name in unknown:
        findings.error(
            "GB870", f"`{system.name}` has no state, condition, input or constant `{name}`", None,
            help=suggestion(name, known), subject=name,
        )  # fmt: skip
    moved = system.with_values({name: value for name, value in point.items() if name in system.parameters})
    missing = [*(name for name in system.states if name not in point), *moved.missing]
    if missing:
        findings.error(
            "GB871", "the point gives no value for " + ", ".join(f"`{name}`" for name in missing), None,
            help="write every state, and every condition without a default: "
            + ",".join(f"{name}=..." for name in missing),
        )  # fmt: skip
    if unknown or missing:
        return None
    return moved, np.array([float(point[name]) for name in system.states])


def require_autonomous(system: System, what: str) -> None:
    """Raises UserError if `what` is not defined: the right-hand side depends on time, or a value is missing."""
    findings = Findings()
    if system.depends_on_time:
        findings.error(
            "GB873", f"`{system.name}` depends on time explicitly and therefore has no {what}", None,
            help="replace time in the balances by a condition or an input that can be held",
        )  # fmt: skip
    if system.missing:
        names = ", ".join(f"`{name}`" for name in system.missing)
        findings.error(
            "GB871", f"{what} need a value for {names}", None,
            help="give it: " + " ".join(f"--set {name}=..." for name in system.missing),
        )  # fmt: skip
    findings.raise_if_failed()
