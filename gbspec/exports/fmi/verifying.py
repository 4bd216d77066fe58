"""Compares a compiled functional mock-up unit with the generated module, through the functions of the standard."""

from __future__ import annotations

import ctypes
import tempfile
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import CompilerError
from gbspec.exports.checking import Points, Quantity, Reference, compare, draw, with_past
from gbspec.exports.fmi.description import Version
from gbspec.exports.fmi.variables import Variables

ACCEPTED = 1e-11
POINTS = 4
Real, Reference32, Count = ctypes.c_double, ctypes.c_uint32, ctypes.c_size_t


class Unit:
    """An instance for model exchange of a unit in a shared library."""

    def __init__(self, path: Path, version: Version, token: str, start: float) -> None:
        self._dll, self.version = ctypes.CDLL(str(path)), version
        create = self._dll["fmi2Instantiate" if version == "2" else "fmi3InstantiateModelExchange"]
        create.restype = ctypes.c_void_p
        given = (b"check", 0, token.encode(), None, None, 0, 0) if version == "2" else None
        self._instance = ctypes.c_void_p(
            create(*given) if given else create(b"check", token.encode(), None, False, False, None, None)
        )
        if not self._instance:
            raise CompilerError("the compiled unit makes no instance")
        if version == "2":
            self._call("SetupExperiment", 0, Real(0.0), Real(start), 0, Real(0.0))
            self._call("EnterInitializationMode")
        else:
            self._call("EnterInitializationMode", False, Real(0.0), Real(start), False, Real(0.0))
        self._call("ExitInitializationMode")

    def _call(self, name: str, *arguments: object) -> int:
        status: int = self._dll[f"fmi{self.version}{name}"](self._instance, *arguments)
        return status

    def free(self) -> None:
        """Ends the instance."""
        self._dll[f"fmi{self.version}FreeInstance"](self._instance)

    def set(self, refs: list[int], values: Array, time: float) -> None:
        """Gives variables values, and the time."""
        self._call("SetTime", Real(time))
        more = (Count(len(refs)),) if self.version == "3" else ()
        name = "SetReal" if self.version == "2" else "SetFloat64"
        self._call(name, _refs(refs), Count(len(refs)), (Real * len(refs))(*values), *more)

    def get(self, refs: list[int]) -> Array:
        """The values of variables; NaN if the unit refuses."""
        found, name = (Real * len(refs))(), "GetReal" if self.version == "2" else "GetFloat64"
        more = (Count(len(refs)),) if self.version == "3" else ()
        status = self._call(name, _refs(refs), Count(len(refs)), found, *more)
        return np.array(found) if status == 0 else np.full(len(refs), np.nan)

    def along(self, unknowns: list[int], knowns: list[int], seed: Array) -> Array:
        """The directional derivative of unknowns; NaN if the unit refuses."""
        found, given = (Real * len(unknowns))(), (Real * len(knowns))(*seed)
        sized = [_refs(unknowns), Count(len(unknowns)), _refs(knowns), Count(len(knowns)), given]
        tail = [found] if self.version == "2" else [Count(len(knowns)), found, Count(len(unknowns))]
        status = self._call("GetDirectionalDerivative", *sized, *tail)
        return np.array(found) if status == 0 else np.full(len(unknowns), np.nan)


def _refs(values: list[int]) -> ctypes.Array[ctypes.c_uint32]:
    return (Reference32 * len(values))(*values)


def verify(binary: bytes, version: Version, token: str, variables: Variables) -> list[Quantity]:
    """The errors of derivatives, outputs and directional derivatives of a unit at random points."""
    with tempfile.TemporaryDirectory(prefix="gbspec-fmu-", ignore_cleanup_errors=True) as folder:
        path = Path(folder) / "unit.so"
        path.write_bytes(binary)
        unit = Unit(path, version, token, variables.exported.start)
        try:
            return _errors(unit, variables, with_past(variables.exported, draw(variables.exported, POINTS, 1)))
        finally:
            unit.free()


def _errors(unit: Unit, variables: Variables, points: Points) -> list[Quantity]:
    known = Reference(variables.exported, variables.library.programs, points)
    first, model = variables.first, variables.model
    count = len(model.inputs)
    groups = (("state", model.states), ("parameter", model.conditions), ("input", model.inputs))
    knowns = [first[kind] + i for kind, items in groups for i in range(len(items))]
    offset = first["parameter"] + len(model.conditions)
    knowns += [offset + i for i in range(len(model.constant_names))]
    rates = [first["derivative"] + i for i in range(len(model.states))]
    channels = [first["channel"] + i for i in range(len(model.channels))]
    values, slopes = [], []
    for row, direction in zip(zip(*points.arguments, strict=True), zip(*points.along, strict=True), strict=True):
        unit.set(knowns, np.concatenate([*row[1:3], row[3][:count], row[4]]), row[0])
        values.append(unit.get([*rates, *channels]))
        seed = np.concatenate([*direction[1:3], direction[3][:count], direction[4], [direction[0]]])
        slopes.append(unit.along([*rates, *channels], [*knowns, 0], seed))
    pairs = [
        tuple(np.concatenate(both, axis=1) for both in zip(one, other, strict=True))
        for one, other in ((known.rhs, known.observe), (known.rhs_along, known.observe_along))
    ]
    return [
        compare("the variables of the unit", np.array(values), (pairs[0][0], pairs[0][1]), ACCEPTED),
        compare("the directional derivatives of the unit", np.array(slopes), (pairs[1][0], pairs[1][1]), ACCEPTED),
    ]
