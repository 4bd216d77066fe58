"""The compiled kernel as Python calls it: structs filled with arrays by name, each array checked once."""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray

from gbspec.backends.native.compiler import compiled
from gbspec.backends.native.kernel_text import Source
from gbspec.backends.native.structs import FUNCTIONS, SPACE, STRUCTS, Field
from gbspec.diagnostics import Defect

_TYPES = {"double": np.dtype(np.float64), "int64_t": np.dtype(np.int64), "int32_t": np.dtype(np.int32)}

_STRUCTURES: dict[str, type[ctypes.Structure]] = {
    name: type(
        name,
        (ctypes.Structure,),
        {"_fields_": [(f.name, ctypes.c_int64 if f.shape is None else ctypes.c_void_p) for f in fields]},
    )
    for name, fields in STRUCTS.items()
}

_NAMES = {name: {field.name for field in fields} for name, fields in STRUCTS.items()}

Array = NDArray[np.generic]


class Struct:
    """A struct of the C, filled; it keeps the arrays that its pointers point to."""

    def __init__(self, name: str, sizes: dict[str, int], values: dict[str, Array | int | None]) -> None:
        self.name, self._kept = name, values
        self.pointer = ctypes.byref(_filled(name, dict(sizes), values))


def _filled(name: str, sizes: dict[str, int], values: dict[str, Array | int | None]) -> ctypes.Structure:
    """The structure with pointers to arrays. Raises Defect for one that the C would misread."""
    structure = _STRUCTURES[name]()
    if _NAMES[name] != values.keys():
        raise Defect(f"`{name}` has no or superfluous {', '.join(sorted(_NAMES[name] ^ values.keys()))}")
    for field in STRUCTS[name]:
        value = values[field.name]
        if isinstance(value, np.ndarray) and field.shape is not None:
            _check(name, field, value, sizes)
            setattr(structure, field.name, value.ctypes.data)
        elif isinstance(value, int) and field.shape is None:
            sizes[field.name] = value
            setattr(structure, field.name, value)
        elif value is not None or not field.optional:
            raise Defect(f"`{name}.{field.name}` cannot be {type(value).__name__}")
    return structure


def _check(name: str, field: Field, value: Array, sizes: dict[str, int]) -> None:
    """Whether an array is what the C takes it for; lengths not seen before are noted in `sizes`. Raises Defect."""
    flags, lengths = value.flags, field.lengths
    fits = value.dtype == _TYPES[field.element] and flags.c_contiguous and value.ndim == len(lengths)
    for (length, more), found in zip(lengths, value.shape, strict=False):
        fits = fits and sizes.setdefault(length, found - more) == found - more
    if not fits or (field.written and not flags.writeable):
        wanted = {length: sizes.get(length) for length, _ in lengths}
        raise Defect(f"`{name}.{field.name}` is {value.dtype}{value.shape}, not {field.element} {wanted} in one piece")


class Library:
    """The functions of a compiled kernel. Raises CompilerError where it cannot be compiled."""

    def __init__(self, source: Source) -> None:
        self.sizes, self._library = source.sizes, compiled(source.text)
        for name, (result, parameters) in FUNCTIONS.items():
            function = getattr(self._library, name, None)  # what the Jacobian needs is there in double precision alone
            if function is not None:
                function.restype = None if result == "void" else ctypes.c_int64
                function.argtypes = [_argument(parameter) for parameter in parameters]

    def struct(self, name: str, **values: Array | int | None) -> Struct:
        """A struct filled with arrays; raises Defect for arrays of another type, shape or order than the C takes."""
        return Struct(name, self.sizes, values)

    def work_bytes(self, depth: int) -> int:
        """Bytes of work space of `run` for trajectories of at most `depth` sub-steps."""
        return int(self._library.work_bytes(depth))

    def run(self, data: Struct, inputs: Struct, share: Struct, outputs: Struct, space: Array) -> None:
        """Solves a share of the trajectories forward and back."""
        self._library.run(data.pointer, inputs.pointer, share.pointer, outputs.pointer, space.ctypes.data)

    def interval_bytes(self, depth: int) -> int:
        """Bytes of work space of `intervals` for intervals of at most `depth` sub-steps."""
        return int(self._library.interval_bytes(depth))

    def intervals(self, data: Struct, inputs: Struct, intervals: Struct, space: Array) -> None:
        """The derivatives of the states at the ends of intervals."""
        self._library.intervals(data.pointer, inputs.pointer, intervals.pointer, space.ctypes.data)

    def chain(self, links: Struct) -> None:
        """Chains the derivatives of intervals, and takes those of residuals on the way."""
        self._library.chain(links.pointer)


def _argument(parameter: str) -> type:
    """The type of an argument for ctypes."""
    if parameter in _STRUCTURES:
        return ctypes.POINTER(_STRUCTURES[parameter])
    return ctypes.c_void_p if parameter == SPACE else ctypes.c_int64
