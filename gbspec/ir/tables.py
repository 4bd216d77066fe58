"""Known functions that are given by points: piecewise polynomials, and their applications in expressions.

An application is a sympy function of a class of its own for each table (`lookup`), which knows its table, so that every
printer and every rule finds the polynomials there. Its derivatives are applications again, of higher `order`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import ClassVar, Literal

import numpy as np
import sympy
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.printer import Printer

from gbspec.arrays import Array
from gbspec.ir.forms import Expr

Interpolation = Literal["linear", "pchip", "cubic"]
Outside = Literal["hold", "error"]


@dataclass(frozen=True)
class Curve:
    """A piecewise polynomial of one or two arguments through points.

    `knots` are the places of each argument, increasing; `values` those at all of their combinations, the last argument
    changing fastest. Outside, the nearest value holds, or there is none (NaN).
    """

    knots: tuple[tuple[float, ...], ...]
    values: tuple[float, ...]
    interpolation: Interpolation = "linear"
    outside: Outside = "hold"

    @cached_property
    def digest(self) -> str:
        """A SHA-256 of everything that the function depends on."""
        return hashlib.sha256(repr((self.knots, self.values, self.interpolation, self.outside)).encode()).hexdigest()

    @cached_property
    def coefficients(self) -> Array:
        """[pieces of the first argument, (of the second,) powers of the first, (of the second)], lowest power first.

        A piece is a polynomial of the distance from its lower knot.
        """
        table = np.array(self.values).reshape([len(places) for places in self.knots])
        for axis, places in enumerate(self.knots):
            table = _pieces(np.array(places), table, axis, self.interpolation)
        count = len(self.knots)
        order = [*range(0, 2 * count, 2), *range(1, 2 * count, 2)]  # pieces first, then powers
        return np.ascontiguousarray(table.transpose(order))

    @property
    def degree(self) -> int:
        """The largest power of an argument."""
        return 1 if self.interpolation == "linear" else 3

    def derived(self, order: tuple[int, ...]) -> Array:
        """The coefficients of a derivative, by the order in each argument."""
        found = self.coefficients
        for axis, times in enumerate(order, start=len(order)):
            for _ in range(times):
                powers = np.arange(1, found.shape[axis])
                shape = [1] * found.ndim
                shape[axis] = len(powers)
                found = found.take(powers, axis) * powers.reshape(shape)
        return found

    def value(self, order: tuple[int, ...], *arguments: Array | float) -> Array:
        """The function, or a derivative, at points. Beyond its places it does not change."""
        given = np.broadcast_arrays(*(np.asarray(a, dtype=np.float64) for a in arguments))
        places, steps = [], []
        flat, lost = np.zeros(given[0].shape, dtype=bool), np.zeros(given[0].shape, dtype=bool)
        for knots, x, times in zip(self.knots, given, order, strict=True):
            inside = np.clip(x, knots[0], knots[-1])
            place = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
            places.append(place)
            steps.append(inside - np.asarray(knots)[place])
            beyond = (x < knots[0]) | (x > knots[-1])
            flat |= beyond & (times > 0)
            lost |= np.isnan(x) | (beyond & (self.outside == "error") & (not any(order)))
        found = self.derived(order)[tuple(places)]
        for step in reversed(steps):
            total = np.zeros(found.shape[:-1])
            for power in range(found.shape[-1] - 1, -1, -1):
                total = total * step.reshape(step.shape + (1,) * (total.ndim - step.ndim)) + found[..., power]
            found = total
        return np.asarray(np.where(lost, math.nan, np.where(flat, 0.0, found)))

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """A lower and an upper bound of its values; exact with one argument, or linear in each."""
        if len(self.knots) == 1 or self.interpolation == "linear":
            ends = [*self.values, *self.value((0,), self._turns).tolist()] if len(self.knots) == 1 else self.values
            return min(ends), max(ends)
        widths = [np.diff(places) for places in self.knots]
        size, middle = np.abs(self.coefficients), self.coefficients[..., 0, 0]
        powers = [w[:, None] ** np.arange(size.shape[-1]) for w in widths]
        rest = np.einsum("ijab,ia,jb->ij", size, *powers) - size[..., 0, 0]
        return float(np.min(middle - rest)), float(np.max(middle + rest))

    def direction(self, argument: int) -> int:
        """1 if it never falls along an argument, -1 if it never rises, 0 if neither is known."""
        if len(self.knots) == 1:
            places = np.sort(np.concatenate([self.knots[0], self._turns]))
            changes = np.diff(self.value((0,), places))
            changes[np.abs(changes) < 1e-14 * max(map(abs, self.values))] = 0.0
        elif self.interpolation == "linear":
            changes = np.diff(np.array(self.values).reshape([len(places) for places in self.knots]), axis=argument)
        else:
            return 0
        return 1 if np.all(changes >= 0) else -1 if np.all(changes <= 0) else 0

    @cached_property
    def _turns(self) -> Array:
        """The places within the pieces at which the slope is zero, of one argument."""
        knots = self.knots[0]
        found = []
        for slope, low, high in zip(self.derived((1,)), knots[:-1], knots[1:], strict=True):
            trimmed = np.trim_zeros(slope[::-1], "f")
            roots = np.roots(trimmed) if len(trimmed) > 1 else np.zeros(0)
            found += [low + root.real for root in roots if abs(root.imag) == 0 and 0 < root.real < high - low]
        return np.array(found)


def _pieces(places: Array, values: Array, axis: int, kind: Interpolation) -> Array:
    """The values with an axis replaced by two, pieces and powers; earlier axes are replaced already."""
    moved = np.moveaxis(values, 2 * axis, 0)
    if kind == "linear":
        slopes = np.diff(moved, axis=0) / np.diff(places).reshape(-1, *[1] * (moved.ndim - 1))
        found = np.stack([moved[:-1], slopes], 1)
    elif kind == "pchip":
        found = _hermite(places, moved)
    else:
        from scipy.interpolate import CubicSpline  # not at the top: its import takes longer than most models

        found = np.moveaxis(CubicSpline(places, moved).c[::-1], 0, 1)
    return np.moveaxis(found, [0, 1], [2 * axis, 2 * axis + 1])


def _hermite(x: Array, y: Array) -> Array:
    """The cubic pieces of Fritsch and Butland (1984), SIAM J. Sci. Stat. Comput. 5:300, with slopes at the points that
    are harmonic means of those beside them, or 0 where these differ in sign; scipy's PchipInterpolator has the same."""
    h = np.diff(x)
    m = np.diff(y) / h
    slopes = np.full(len(x), m[0])
    if len(x) > 2:
        one, two = 2 * h[1:] + h[:-1], h[1:] + 2 * h[:-1]
        turns = m[:-1] * m[1:] <= 0
        below, above = np.where(turns, 1.0, m[:-1]), np.where(turns, 1.0, m[1:])
        slopes[1:-1] = np.where(turns, 0.0, (one + two) / (one / below + two / above))
        slopes[0], slopes[-1] = _end_slope(h[0], h[1], m[0], m[1]), _end_slope(h[-1], h[-2], m[-1], m[-2])
    low, high = slopes[:-1], slopes[1:]
    return np.stack([y[:-1], low, (3 * m - 2 * low - high) / h, (low + high - 2 * m) / h**2], 1)


def _end_slope(h: float, next_h: float, m: float, next_m: float) -> float:
    """The slope at an end: that of the parabola through three points, limited so that the piece stays monotone."""
    found = ((2 * h + next_h) * m - h * next_m) / (h + next_h)
    if np.sign(found) != np.sign(m):
        return 0.0
    return 3 * m if np.sign(m) != np.sign(next_m) and abs(found) > 3 * abs(m) else found


class Lookup(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """An application of a table; its subclasses, made by `lookup`, have the table's name and curve, and the order of
    the derivative."""

    table: ClassVar[str]
    curve: ClassVar[Curve]
    order: ClassVar[tuple[int, ...]]
    precedence = PRECEDENCE["Func"]

    @classmethod
    def eval(cls, *arguments: Expr) -> Expr | None:
        """The value, if all arguments are numbers."""
        if max(cls.order) > cls.curve.degree:
            return sympy.S.Zero
        if all(argument.is_number for argument in arguments):
            return sympy.Float(float(cls.curve.value(cls.order, *map(float, arguments))))
        return None

    def fdiff(self, argindex: int = 1) -> Expr:
        """The derivative with respect to an argument (from 1)."""
        return self.slope(argindex - 1)

    def slope(self, argument: int) -> Expr:
        """The derivative with respect to an argument (from 0)."""
        order = tuple(n + (i == argument) for i, n in enumerate(self.order))
        return lookup(self.table, self.curve, order)(*self.args)

    def _eval_is_real(self) -> bool:
        return True

    def _printed(self, printer: Printer, **options: str) -> str:
        marks = "'" * self.order[0] if len(self.order) == 1 else "_" * any(self.order) + "".join(map(str, self.order))
        return f"{self.table}{marks if any(self.order) else ''}({printer.stringify(self.args, ', ')})"

    _sympystr = _sympyrepr = _printed


@cache
def lookup(name: str, curve: Curve, order: tuple[int, ...] | None = None) -> type[Lookup]:
    """The sympy function of a table, or of one of its derivatives."""
    if order is None:
        return lookup(name, curve, (0,) * len(curve.knots))

    def value(*arguments: Array | float) -> Array:
        return curve.value(order, *arguments)

    # The name must not be that of a function of sympy, mpmath or numpy: printers and `evalf` look for these.
    text = f"table_{name}_{curve.digest[:8]}_{'_'.join(map(str, order))}"
    content = {"table": name, "curve": curve, "order": order, "nargs": len(order), "_imp_": staticmethod(value)}
    return type(text, (Lookup,), content)


def without_values(curves: Mapping[str, Curve]) -> str:
    """Which known functions have no value beyond their points (`outside error`); empty without such."""
    ends = [
        f"`{name}` has no value outside of {' x '.join(f'[{k[0]:g}, {k[-1]:g}]' for k in curve.knots)}"
        for name, curve in curves.items()
        if curve.outside == "error"
    ]
    return f"{'; '.join(ends)} (`outside error`)" if ends else ""
