"""The Python side of the compiled kernel: structs filled with arrays by name; each array is checked once."""

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

AnyArray = NDArray[np.generic]


class Struct:
    """A filled C struct; it keeps references to the arrays that its pointers point to."""

    def __init__(self, name: str, sizes: dict[str, int], values: dict[str, AnyArray | int | None]) -> None:
        self.name, self._kept = name, values
        self.pointer = ctypes.byref(_filled(name, dict(sizes), values))


def _filled(name: str, sizes: dict[str, int], values: dict[str, AnyArray | int | None]) -> ctypes.Structure:
    """The structure with pointers to arrays. Raises Defect for an array that the C code would misread."""
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


def _check(name: str, field: Field, value: AnyArray, sizes: dict[str, int]) -> None:
    """Checks type, shape and order of an array, and adds new lengths to `sizes`. Raises Defect."""
    flags, lengths = value.flags, field.lengths
    fits = value.dtype == _TYPES[field.element] and flags.c_contiguous and value.ndim == len(lengths)
    for (length, more), found in zip(lengths, value.shape, strict=False):
        fits = fits and sizes.setdefault(length, found - more) == found - more
    if not fits or (field.written and not flags.writeable):
        wanted = {length: sizes.get(length) for length, _ in lengths}
        raise Defect(f"`{name}.{field.name}` is {value.dtype}{value.shape}, not contiguous {field.element} {wanted}")


class Library:
    """The functions of a compiled kernel. Raises CompilerError if it cannot be compiled."""

    def __init__(self, source: Source) -> None:
        self.sizes, self._library = source.sizes, compiled(source.text)
        for name, (result, parameters) in FUNCTIONS.items():
            function = getattr(self._library, name, None)  # some functions exist in double precision only
            if function is not None:
                function.restype = None if result == "void" else ctypes.c_int64
                function.argtypes = [_argument(parameter) for parameter in parameters]

    def struct(self, name: str, **values: AnyArray | int | None) -> Struct:
        """A struct filled with arrays. Raises Defect for a type, shape or order that the C code does not expect."""
        return Struct(name, self.sizes, values)

    def work_bytes(self, depth: int) -> int:
        """Bytes of work space of `run` for trajectories of at most `depth` sub-steps."""
        return int(self._library.work_bytes(depth))

    def run(self, data: Struct, inputs: Struct, share: Struct, outputs: Struct, space: AnyArray) -> None:
        """Solves a share of the trajectories, with the reverse pass if requested."""
        self._library.run(data.pointer, inputs.pointer, share.pointer, outputs.pointer, space.ctypes.data)

    def interval_bytes(self, depth: int) -> int:
        """Bytes of work space of `intervals` for intervals of at most `depth` sub-steps."""
        return int(self._library.interval_bytes(depth))

    def intervals(self, data: Struct, inputs: Struct, intervals: Struct, space: AnyArray) -> None:
        """Computes the derivatives of the states at the ends of intervals."""
        self._library.intervals(data.pointer, inputs.pointer, intervals.pointer, space.ctypes.data)

    def chain(self, links: Struct) -> None:
        """Chains the derivatives of intervals and computes those of the residuals."""
        self._library.chain(links.pointer)

    def sensitivity_bytes(self, depth: int, columns: int, window: int) -> int:
        """Bytes of work space of `sensitivities` for trajectories of at most `depth` sub-steps."""
        return int(self._library.sensitivity_bytes(depth, columns, window))

    def sensitivities(self, data: Struct, inputs: Struct, given: Struct, space: AnyArray) -> None:
        """Computes the derivatives of measured values, in models with delays."""
        self._library.sensitivities(data.pointer, inputs.pointer, given.pointer, space.ctypes.data)

    def control(self, data: Struct, inputs: Struct, walk: Struct, space: AnyArray) -> bool:
        """Finds the steps of a tile of trajectories; whether there was room for all."""
        return bool(self._library.control(data.pointer, inputs.pointer, walk.pointer, space.ctypes.data))


def _argument(parameter: str) -> type:
    """The ctypes type of a parameter."""
    if parameter in _STRUCTURES:
        return ctypes.POINTER(_STRUCTURES[parameter])
    return ctypes.c_void_p if parameter == SPACE else ctypes.c_int64
