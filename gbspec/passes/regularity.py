"""Whether equations determine their variables for generic values: the rank of their Jacobian at random points."""

from __future__ import annotations

import random
from collections.abc import Sequence

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from gbspec.arrays import Array
from gbspec.ir import Expr, Lookup, Model, between_jumps

POINTS = 8
SMALL = 1e-9
"""A singular value below this share of the largest one counts as zero, after the scaling of rows and columns."""


def dependent(model: Model, residuals: Sequence[Expr], variables: Sequence[sympy.Symbol]) -> list[int]:
    """The residuals whose derivatives by the variables are linearly dependent at all points tried; none if they are
    independent at one of them, or have values at none."""
    draw = random.Random(1)
    general = [_general(residual, draw) for residual in residuals]
    slopes = sympy.Matrix([[between_jumps(value, variable) for variable in variables] for value in general])
    symbols = sorted(slopes.free_symbols, key=lambda symbol: symbol.name)
    known = {c.symbol: c.value for c in model.constants}
    wrong: list[int] = []
    for _ in range(POINTS):
        point = {symbol: known.get(symbol, _value(model, symbol, draw)) for symbol in symbols}
        matrix = _numbers(slopes, point)
        if matrix is None:
            continue
        rows = _dependent_rows(matrix)
        if not rows:
            return []
        wrong = rows
    return wrong


def _general(expression: Expr, draw: random.Random) -> Expr:
    """The expression with unknown functions and tables as smooth functions that have no special properties."""
    waves: dict[str, list[float]] = {}

    def wave(name: str, arguments: Sequence[Expr]) -> Expr:
        numbers = waves.setdefault(name, [draw.uniform(0.3, 1.7) for _ in range(len(arguments) + 1)])
        return sympy.exp(sympy.sin(numbers[0] + sum(n * a for n, a in zip(numbers[1:], arguments, strict=True))))

    return expression.replace(
        lambda node: isinstance(node, AppliedUndef | Lookup),
        lambda node: wave(getattr(type(node), "table", type(node).__name__), node.args),
    )


def _value(model: Model, symbol: sympy.Symbol, draw: random.Random) -> float:
    """A value of a quantity: inside its range where it has one, else positive."""
    for group in (model.algebraics, model.states, model.conditions, model.inputs, model.learnables):
        for item in group:
            if item.symbol == symbol and item.range is not None and item.range.bounded:
                return draw.uniform(item.range.low, item.range.high)
    return draw.uniform(0.3, 1.7)


def _numbers(slopes: sympy.Matrix, point: dict[sympy.Symbol, float]) -> Array | None:
    """The matrix at a point; None where it has no value."""
    try:
        found = [complex(sympy.N(entry.subs(point))) for entry in slopes]
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        return None
    matrix = np.array(found).reshape(slopes.shape)
    if not np.isfinite(matrix).all() or np.abs(matrix.imag).max(initial=0.0) > 0:
        return None
    return np.ascontiguousarray(matrix.real)


def _dependent_rows(matrix: Array) -> list[int]:
    """The rows that take part in a linear dependence."""
    sizes = np.abs(matrix).max(axis=1, keepdims=True)
    if not sizes.all():
        return [int(i) for i in np.flatnonzero(sizes[:, 0] == 0)]
    matrix = matrix / sizes
    columns = np.abs(matrix).max(axis=0)
    matrix = matrix / np.where(columns > 0, columns, 1.0)
    left, values, _ = np.linalg.svd(matrix)
    if values[-1] > SMALL * values[0]:
        return []
    return [int(i) for i in np.flatnonzero(np.abs(left[:, -1]) > SMALL**0.5)]
