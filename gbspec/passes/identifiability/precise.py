"""Directions by numbers of many digits, where those of machine precision cannot tell small effects from none.

Where states and constants differ by many decades, as the first infected among a large population, what tells constants
apart may be smaller than rounding: an effect of second order in `I0/N` is 1e-10 of the others for `N` = 1e5. With 120
digits the rank of the same system does not depend on the units and sizes of anything.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.ir import Expr
from gbspec.passes.identifiability.branches import Branches
from gbspec.passes.identifiability.jets import Base, LinearSystem, system_at
from gbspec.passes.identifiability.question import Question
from gbspec.passes.identifiability.series import Algebra, OutOfEffortError

DIGITS = 120
ZERO_DIGITS = 60
"""Pivots below 10 to minus this of the largest are zero: far above rounding, far below any effect."""
COST = 100
"""What a product of such numbers costs, in multiplications of machine numbers."""
SUPPORTED = ("exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "atan", "asin", "acos", "erf")


@cache
def _context() -> Any:  # mpmath has no types
    """Arithmetic of its own precision, so that of other users of mpmath stays as it is."""
    import mpmath

    context = mpmath.mp.clone()
    context.dps = DIGITS
    return context


@dataclass(frozen=True)
class Precise(Algebra):
    """The same arithmetic with numbers of many digits, in arrays of objects; `varied`: whether series depend on s."""

    varied: bool = True

    @cached_property
    def monomials(self) -> tuple[tuple[int, int], ...]:
        """The same exponents; of s none but 0 and 1 where series do not depend on it."""
        return tuple((i, j) for i, j in super().monomials if self.varied or j <= 1)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """An array of zeros of many digits."""
        return np.full(shape, _context().mpf(0), dtype=object)

    def numbers(self, values: Array | float) -> Array:
        """Numbers as they are written: 0.1 is a tenth, not the nearest machine number."""
        mpf = _context().mpf
        convert = np.frompyfunc(lambda v: mpf(repr(float(v))) if isinstance(v, float | int | np.number) else v, 1, 1)
        return np.asarray(convert(np.asarray(values, dtype=object)), dtype=object)

    def number(self, e: Expr) -> float:
        """The value of an expression without symbols, with many digits."""
        text = repr(float(e)) if e.is_Float else str(sympy.N(e, DIGITS))
        number: float = _context().mpf(text)
        return number

    def times(self, a: Array, b: Array) -> Array:
        """The product, at its higher cost."""
        size = float(np.prod(np.broadcast_shapes(a.shape, b.shape)))
        self.effort.spend(COST * size * max(1, self.size // 4))
        return super().times(a, b)

    def exp(self, a: Array) -> Array:
        """e^a."""
        return self.compose(_applied("exp", a[..., :1]) / self._factorials, a)

    def log(self, a: Array) -> Array:
        """The natural logarithm."""
        first = a[..., 0]
        terms = [_applied("log", first)]
        terms += [-((-1) ** k) * first ** (-k) / k for k in range(1, self.order + 1)]
        return self.compose(np.stack(terms, axis=-1), a)

    def wave(self, a: Array, shift: int) -> Array:
        """sin (shift 0) or cos (shift 1)."""
        sine, cosine = _applied("sin", a[..., 0]), _applied("cos", a[..., 0])
        cycle = (sine, cosine, -sine, -cosine)
        terms = [cycle[(shift + k) % 4] for k in range(self.order + 1)]
        return self.compose(np.stack(terms, axis=-1) / self._factorials, a)

    def general(self, name: str, a: Array) -> Array:
        """Any other function of one argument."""
        context = _context()
        rows = [context.taylor(getattr(context, name), v, self.order) for v in np.ravel(a[..., 0])]
        table = np.array([[context.mpf(c) for c in row] for row in rows], dtype=object)
        return self.compose(table.reshape(*a.shape[:-1], self.order + 1), a)


def _applied(name: str, values: Array) -> Array:
    return np.asarray(np.frompyfunc(getattr(_context(), name), 1, 1)(values), dtype=object)


def examinable(question: Question) -> bool:
    """Whether the arithmetic has all formulas of a question: of known functions, without branches and jumps in time."""
    if question.applications or any(dose.lag.free_symbols for dose in question.doses) or Branches(question).atoms:
        return False
    starts = [start for start in question.starts if start is not None]
    each = {f for e in (*question.rates, *question.outputs, *starts) for f in e.atoms(sympy.Function)}
    return all(f.func.__name__ in SUPPORTED for f in each)


def null_at(base: Base, algebra: Precise, lines: int, rng: np.random.Generator) -> Array | None:
    """The directions of the sought constants, as columns in units of their sizes, at one point; None where the effort
    is spent or a formula has no value there."""
    try:
        system = system_at(base, algebra, lines, rng)
        rows, columns = system.matrix.shape
        algebra.effort.spend(COST * rows * columns * min(rows, columns))
        return _null(system, algebra)
    except (OutOfEffortError, ArithmeticError, ValueError, TypeError):
        return None


def _null(system: LinearSystem, algebra: Precise) -> Array:
    """The null space in the constants of what is left of the equations without initial values and own constants."""
    count = system.constants
    matrix = algebra.numbers(system.matrix) * algebra.numbers(system.sizes)
    others, constants = matrix[:, count:], matrix[:, :count]
    order = [*range(others.shape[1])]
    matrix = np.concatenate([others, constants], axis=1)
    top, _ = _eliminated(matrix, 0, order)
    # Rows below have none of the others left: these are the equations in the constants only.
    rest = matrix[top:, others.shape[1] :]
    rank, pivots = _eliminated(rest, 0, [*range(count)])
    free = [column for column in range(count) if column not in pivots]
    found = np.zeros((count, len(free)))
    for k, column in enumerate(free):
        found[column, k] = 1.0
        for row in range(rank):
            found[pivots[row], k] = -float(rest[row, column] / rest[row, pivots[row]])
    return np.asarray(np.linalg.qr(found)[0]) if free else found


def _eliminated(matrix: Array, top: int, columns: list[int]) -> tuple[int, list[int]]:
    """Gauss-Jordan elimination in place of some columns, the largest pivot of rows and columns scaled to their own
    sizes first; the number of pivots, and their columns."""
    _balance(matrix)
    small, pivots = _context().mpf(10) ** -ZERO_DIGITS, list[int]()
    left = list(columns)
    while left and top < len(matrix):
        sizes = np.abs(matrix[top:][:, left])
        row, place = (int(i) for i in np.unravel_index(int(np.argmax(sizes)), sizes.shape))
        if sizes[row, place] < small:
            break
        column = left.pop(place)
        matrix[[top, top + row]] = matrix[[top + row, top]]
        factors = matrix[:, column] / matrix[top, column]
        factors[top] = factors[top] * 0
        touched = np.flatnonzero(factors != 0)
        matrix[touched] = matrix[touched] - factors[touched, None] * matrix[top]
        pivots.append(column)
        top += 1
    return top, pivots


def _balance(matrix: Array) -> None:
    """Scales each row by its largest entry; those of rounding alone are zero."""
    small = _context().mpf(10) ** -ZERO_DIGITS
    for row in matrix:
        largest = max((abs(v) for v in row), default=0)
        row *= 1 / largest if largest > small else 0
