"""Starts in a steady state, by the evaluator's functions and the generated module's search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from gbspec.arrays import Array
from gbspec.backends.protocol import Casadi, GeneratedModule
from gbspec.diagnostics import ComputationError


class Course(Protocol):
    """An input over time: values [n] at times [n]."""

    @property
    def times(self) -> ArrayLike:
        """When."""

    @property
    def values(self) -> ArrayLike:
        """Its values."""


def first_values(instance: GeneratedModule, courses: Sequence[Course], start: float | None) -> Array:
    """The inputs [n_inputs] at the start; without courses their defaults."""
    if not courses:
        return np.array([np.nan if value is None else value for value in instance.defaults["inputs"]], dtype=np.float64)
    found = []
    for course, kind in zip(courses, instance.interpolation, strict=True):
        times, values = np.asarray(course.times, dtype=np.float64), np.asarray(course.values, dtype=np.float64)
        at = float(times[0]) if start is None else start
        place = max(int(np.searchsorted(times, at, side="right")) - 1, 0)
        found.append(float(np.interp(at, times, values)) if kind == "linear" else float(values[place]))
    return np.array(found)


def steady_start(
    instance: GeneratedModule,
    functions: tuple[Casadi, Casadi],
    start: Array,
    condition: Array,
    inputs: Array,
    constants: Array,
) -> Array:
    """The start [n] with the steady state in place of the declared values; `functions` are the rates and their
    Jacobian.

    Raises ComputationError, with the state, where there is none.
    """
    equations, m = instance.equations, instance.arithmetic("numpy")
    if any(not timed for _, timed, _ in getattr(equations, "events", ())):
        return _followed(instance, start, condition, inputs, constants)
    free = list(equations.steady_states)
    own = condition
    condition, inputs, rows, chosen = equations.steady(m, condition, inputs, tuple(constants))
    if not chosen > 0:
        return start
    laws = np.array([[float(c) for c in row] for row in rows]).reshape(1, -1, len(free))

    def whole(z: Array) -> Array:
        x = start.copy()
        x[free] = z[0]
        return x

    def slopes(z: Array) -> Array:
        found = functions[0](0.0, whole(z), condition, inputs, constants)
        return np.asarray(found, dtype=np.float64).reshape(1, -1)[:, free]

    def jacobians(z: Array) -> Array:
        found = np.asarray(functions[1](0.0, whole(z), condition, inputs, constants), dtype=np.float64)
        return found[np.ix_(free, free)][None]

    found, failed = equations.settled(slopes, jacobians, start[free][None], laws)
    for place, reason in failed.values():
        raise _none(instance.states[free[place]], reason)
    if not hasattr(equations, "resumed"):
        return whole(found)
    return np.array(equations.resumed(m, whole(found), own, tuple(constants)), dtype=np.float64)


def _none(state: str, reason: str) -> ComputationError:
    return ComputationError(
        f"there is no steady start of `{state}`: {reason}",
        where="the search for the steady state, from the declared starts",
        remedy="give a start nearer to the steady state (`state X = …`), or a start in place of `initial steady`",
    )


def _followed(instance: GeneratedModule, start: Array, condition: Array, inputs: Array, constants: Array) -> Array:
    """The same by the module's steps, which are cut at events. Raises ComputationError."""
    equations = instance.equations
    found, failed = equations.followed(instance, start, condition, inputs, constants)
    for place, reason in failed.values():
        raise _none(instance.states[equations.steady_states[place]], reason)
    return np.array(found, dtype=np.float64)
