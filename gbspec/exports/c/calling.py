"""Calls a compiled C library from Python, to compare it with the generated module."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gbspec.arrays import Array
from gbspec.exports.c.delays import MARKS, room
from gbspec.exports.c.library import Library
from gbspec.exports.checking import Course, Points

Doubles = ctypes.POINTER(ctypes.c_double)
DoublePointer: TypeAlias = "ctypes._Pointer[ctypes.c_double] | None"


class _Course(ctypes.Structure):
    _fields_ = (("count", ctypes.c_int), ("times", Doubles), ("values", Doubles))


class Compiled:
    """The functions of a library that was compiled to a file, over points."""

    def __init__(self, path: Path, library: Library) -> None:
        self.library, self.prefix = library, library.prefix
        self._dll = ctypes.CDLL(str(path))
        for name in ("simulate", "outside"):
            self._function(name).restype = ctypes.c_int

    def _function(self, name: str) -> ctypes._NamedFuncPointer:
        found: ctypes._NamedFuncPointer = self._dll[f"{self.prefix}_{name}"]
        return found

    def values(self, name: str, points: Points, width: int) -> Array:
        """`rhs`, `observe` or `functions` [R, width] at the points."""
        out, function = np.zeros((len(points), width)), self._function(name)
        for i, (t, x, condition, inputs, constants) in enumerate(zip(*points.arguments, strict=True)):
            parameters = np.concatenate([condition, constants, [0.0]])
            function(_of(parameters), ctypes.c_double(t), _of(x), _of(inputs), _of(out[i]))
        return out

    def delays(self, points: Points) -> tuple[Array, Array]:
        """How long delays are [R, lags] and what is delayed [R, delays] at the points."""
        programs = self.library.programs
        lags, late = (np.zeros((len(points), len(flat.outputs))) for flat in (programs.lags, programs.delayed))
        for i, (t, x, condition, inputs, constants) in enumerate(zip(*points.arguments, strict=True)):
            parameters = np.concatenate([condition, constants, [0.0]])
            self._function("lags")(_of(parameters), _of(lags[i]))
            self._function("delayed")(_of(parameters), ctypes.c_double(t), _of(x), _of(inputs), _of(late[i]))
        return lags, late

    def along(self, name: str, points: Points, width: int) -> Array:
        """Their derivatives along the points' directions."""
        out, function = np.zeros((len(points), width)), self._function(f"{name}_along")
        rows = zip(zip(*points.arguments, strict=True), zip(*points.along, strict=True), strict=True)
        for i, (given, direction) in enumerate(rows):
            (t, x, condition, inputs, constants), (dt, dx, dc, du, dk) = given, direction
            p, dp = np.concatenate([condition, constants, [0.0]]), np.concatenate([dc, dk, [0.0]])
            first = _of(p), ctypes.c_double(t), _of(x), _of(inputs)
            function(*first, _of(dp), ctypes.c_double(dt), _of(dx), _of(du), _of(out[i]))
        return out

    def unknown(self, name: str, constants: Array, condition: Array, arguments: Sequence[Array]) -> Array:
        """A learned function [R] at arguments [R] each; `name` is its C name."""
        function = self._dll[name]
        function.restype = ctypes.c_double
        out = []
        for row, own, given in zip(zip(*arguments, strict=True), constants, condition, strict=True):
            p = np.concatenate([given, own, [0.0]])
            out.append(function(_of(p), *(ctypes.c_double(value) for value in row)))
        return np.array(out)

    def outside(self, points: Points) -> Array:
        """Whether each point is outside of what was learned."""
        function, out = self._function("outside"), []
        for t, x, condition, inputs, constants in zip(*points.arguments, strict=True):
            p = np.concatenate([condition, constants, [0.0]])
            out.append(function(_of(p), ctypes.c_double(t), _of(x), _of(inputs), None))
        return np.array(out, dtype=bool)

    def _past(self) -> tuple[ctypes.Array[ctypes.c_char], ...]:
        """Room for the solution so far of a model with delays."""
        model = self.library.model
        if not model.delays:
            return ()
        wide = 4 * (len(model.states) + len(model.inputs) + 2)
        return (
            ctypes.create_string_buffer(
                8 * (wide + 2 * MARKS + wide * room(self.library.exported, self.library.programs))
            ),
        )

    def simulate(self, points: Points, course: Course, point: int = 0) -> tuple[Array, Array]:
        """States [T, n] and channels [T, C] of a course from the states of a point."""
        model, count = self.library.model, len(course.times)
        states, channels = np.zeros((count, len(model.states))), np.zeros((count, len(model.channels)))
        p = np.concatenate([points.condition[point], points.constants[point], [0.0]])
        inputs = (_Course * max(len(course.inputs), 1))(*(_course(s.times, s.values) for s in course.inputs))
        doses = (_Course * max(len(course.doses), 1))(*(_course(d.times, d.amounts) for d in course.doses))
        times, x0 = np.ascontiguousarray(course.times), np.ascontiguousarray(points.x[point])
        status = self._function("simulate")(
            _of(p), ctypes.c_double(course.start), _of(x0), inputs, doses, ctypes.c_int(count), _of(times),
            ctypes.c_double(course.max_step), _of(states), _of(channels), *self._past(),
        )  # fmt: skip
        return (
            (states, channels)
            if status not in (1, 3, 4)
            else (np.full_like(states, np.nan), np.full_like(channels, np.nan))
        )


def _of(array: Array) -> DoublePointer:
    return array.ctypes.data_as(Doubles) if array.size else None


def _course(times: Array, values: Array) -> _Course:
    return _Course(len(times), _of(np.ascontiguousarray(times)), _of(np.ascontiguousarray(values)))
