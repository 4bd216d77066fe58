"""CasADi functions called from numpy through their buffers: about one microsecond per call instead of fifty."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from gbspec.arrays import Array
from gbspec.backends import Casadi


class Compiled:
    """A casadi.Function as a numpy function.

    It takes one array per argument (any shape of the right size; matrices column by column, as CasADi stores them) and
    returns a tuple with one new array per result: [rows] for a column, [rows, columns] otherwise. It must not be shared
    between threads, since its buffers are reused.
    """

    def __init__(self, function: Casadi) -> None:
        import casadi

        arguments = [casadi.MX.sym(f"a{i}", *function.size_in(i)) for i in range(function.n_in())]
        results = function.call(arguments)
        self.function = casadi.Function(function.name(), arguments, [casadi.densify(result) for result in results])
        self._maps: dict[int, Casadi] = {}
        self._shapes = [self.function.size_out(i) for i in range(self.function.n_out())]
        self._arguments = [np.zeros(self.function.numel_in(i)) for i in range(self.function.n_in())]
        self._results = [np.zeros(rows * columns) for rows, columns in self._shapes]
        self._buffer, self._trigger = cast(Casadi, self.function).buffer()
        for i, argument in enumerate(self._arguments):
            self._buffer.set_arg(i, memoryview(cast(Casadi, argument)))
        for i, result in enumerate(self._results):
            self._buffer.set_res(i, memoryview(cast(Casadi, result)))

    def __call__(self, *arguments: ArrayLike) -> tuple[Array, ...]:
        """The results at one point."""
        for target, argument in zip(self._arguments, arguments, strict=True):
            target[:] = np.ravel(np.asarray(argument, dtype=float), order="F")
        self._trigger()
        return tuple(
            result.copy() if columns == 1 else result.reshape((rows, columns), order="F").copy()
            for result, (rows, columns) in zip(self._results, self._shapes, strict=True)
        )

    def many(self, *arguments: ArrayLike) -> tuple[Array, ...]:
        """The results at N points: arguments [N, size] (or [size], shared), results [N, rows] or [N, rows, columns]."""
        arrays = [np.asarray(argument, dtype=float) for argument in arguments]
        count = max((array.shape[0] for array in arrays if array.ndim == 2), default=1)
        mapped = self._maps.get(count)
        if mapped is None:
            mapped = self._maps[count] = self.function.map(count)
        columns = [array.T if array.ndim == 2 else np.repeat(array.reshape(-1, 1), count, axis=1) for array in arrays]
        results = mapped.call([np.asfortranarray(column) for column in columns])
        return tuple(self._unmapped(result, shape, count) for result, shape in zip(results, self._shapes, strict=True))

    @staticmethod
    def _unmapped(result: Casadi, shape: tuple[int, int], count: int) -> Array:
        rows, columns = shape
        flat = np.asarray(result.full(), dtype=float)
        if columns == 1:
            return np.ascontiguousarray(flat.T)
        return np.ascontiguousarray(flat.reshape(rows, count, columns).transpose(1, 0, 2))
