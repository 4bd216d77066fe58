"""Values of many points with their first and second derivatives, in numpy: an arithmetic for a model's equations.

The derivatives of small models by autodifferentiation of tensors cost far more than the numbers in them. A `Jet` is a
value with its derivatives in p variables, of which the first n are coordinates, and with second derivatives in the
coordinates and all variables: what the matrices of linear models and of starts need with their gradients (forward mode,
Griewank and Walther 2008, chapter 13).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from scipy import special

from gbspec.arrays import Array

Slopes: TypeAlias = Array | None
"""Derivatives; None where they are zero."""


class Jet:
    """Values [B], derivatives `first` [B, p] and, for n > 0, `second` [B, n, p]; None where these are zero."""

    __slots__ = ("first", "n", "second", "value")
    __array_ufunc__ = None

    def __init__(self, value: Any, first: Slopes = None, second: Slopes = None, n: int = 0) -> None:
        self.value, self.first, self.second, self.n = np.asarray(value), first, second, n

    def chained(self, value: Array, slope: Any, bend: Any) -> Jet:
        """A function of this with these values and its first and second derivative."""
        if self.first is None:
            return Jet(value)
        first = np.asarray(slope)[..., None] * self.first
        second = None
        if self.n:
            second = _outer(np.asarray(bend), self.first, self.first, self.n) if np.any(bend) else None
            if self.second is not None:
                second = _sum(second, np.asarray(slope)[..., None, None] * self.second)
        return Jet(value, first, second, self.n)

    def __add__(self, other: Any) -> Jet:
        other = jet(other)
        return Jet(
            self.value + other.value,
            _sum(self.first, other.first),
            _sum(self.second, other.second),
            max(self.n, other.n),
        )

    __radd__ = __add__

    def __neg__(self) -> Jet:
        return Jet(-self.value, _negative(self.first), _negative(self.second), self.n)

    def __sub__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.value - other, self.first, self.second, self.n)
        return self.__add__(-other)

    def __rsub__(self, other: Any) -> Jet:
        return (-self).__add__(other)

    def __mul__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            by = np.asarray(other)
            return Jet(self.value * by, _scaled(self.first, by, 1), _scaled(self.second, by, 2), self.n)
        value, n = self.value * other.value, max(self.n, other.n)
        first = _sum(_scaled(self.first, other.value, 1), _scaled(other.first, self.value, 1))
        if not n:
            return Jet(value, first)
        second = _sum(_scaled(self.second, other.value, 2), _scaled(other.second, self.value, 2))
        if self.first is not None and other.first is not None:
            one = np.ones(())
            both = _outer(one, self.first, other.first, n) + _outer(one, other.first, self.first, n)
            second = _sum(second, both)
        return Jet(value, first, second, n)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Jet:
        if not isinstance(other, Jet):
            return self * (1 / np.asarray(other))
        return self * other.reciprocal()

    def __rtruediv__(self, other: Any) -> Jet:
        return self.reciprocal().__mul__(other)

    def reciprocal(self) -> Jet:
        """1 over this."""
        value = 1 / self.value
        return self.chained(value, -(value**2), 2 * value**3 if self.n else 0.0)

    def __pow__(self, exponent: Any) -> Jet:
        if isinstance(exponent, Jet):
            found: Jet = exp(exponent * log(self)) if exponent.first is not None else self**exponent.value
            return found
        e, x = np.asarray(exponent, dtype=np.float64), self.value
        slope = np.where(e == 0, 0.0, e * x ** np.where(e == 0, 1.0, e - 1))
        flat = (e == 0) | (e == 1)
        return self.chained(x**e, slope, np.where(flat, 0.0, e * (e - 1) * x ** np.where(flat, 1.0, e - 2)))

    def __rpow__(self, base: Any) -> Jet:
        found: Jet = exp(self * np.log(base))
        return found

    def __lt__(self, other: Any) -> Any:
        return self.value < jet(other).value

    def __le__(self, other: Any) -> Any:
        return self.value <= jet(other).value

    def __gt__(self, other: Any) -> Any:
        return self.value > jet(other).value

    def __ge__(self, other: Any) -> Any:
        return self.value >= jet(other).value


class Vector(tuple[Any, ...]):
    """Components, each a jet, an array [B] or a number, with the arithmetic that steps of a solver need."""

    __slots__ = ()
    __array_ufunc__ = None

    def __add__(self, other: Any) -> Vector:
        return Vector(a + b for a, b in zip(self, other, strict=True))

    def __sub__(self, other: Any) -> Vector:
        return Vector(a - b for a, b in zip(self, other, strict=True))

    def __mul__(self, factor: Any) -> Vector:
        return Vector(a * factor for a in self)

    __rmul__ = __mul__

    def __truediv__(self, factor: Any) -> Vector:
        return Vector(a / factor for a in self)

    def value(self, count: int) -> Array:
        """The values [B, m] at B = `count` points."""
        out = np.empty((count, len(self)))
        for i, part in enumerate(self):
            out[:, i] = part.value if isinstance(part, Jet) else part
        return out

    def slopes(self, count: int, p: int) -> Array:
        """The first derivatives [B, m, p]."""
        out = np.zeros((count, len(self), p))
        for i, part in enumerate(self):
            if isinstance(part, Jet) and part.first is not None:
                out[:, i] = part.first
        return out

    def bends(self, count: int, n: int, p: int) -> Array:
        """The second derivatives [B, m, n, p]."""
        out = np.zeros((count, len(self), n, p))
        for i, part in enumerate(self):
            if isinstance(part, Jet) and part.second is not None:
                out[:, i] = part.second
        return out


def jet(value: Any) -> Jet:
    """A value as a jet."""
    return value if isinstance(value, Jet) else Jet(value)


def _sum(a: Slopes, b: Slopes) -> Slopes:
    if a is None or b is None:
        return b if a is None else a
    return a + b


def _negative(a: Slopes) -> Slopes:
    return None if a is None else -a


def _scaled(table: Slopes, by: Array, axes: int) -> Slopes:
    return None if table is None else table * by.reshape(by.shape + (1,) * axes)


def _outer(by: Array, a: Array, b: Array, n: int) -> Array:
    left = a[..., :n] if by.ndim == 0 and float(by) == 1.0 else by[..., None] * a[..., :n]
    return np.asarray(left[..., :, None] * b[..., None, :])


def _unary(
    function: Callable[[Array], Array], slopes: Callable[[Array, Array], tuple[Any, Any]]
) -> Callable[[Any], Any]:
    """A function of numbers or jets; `slopes(x, f(x))` are its first two derivatives."""

    def of(x: Any) -> Any:
        if not isinstance(x, Jet):
            return function(np.asarray(x))
        value = function(x.value)
        return x.chained(value, *slopes(x.value, value))

    return of


exp = _unary(np.exp, lambda x, f: (f, f))
log = _unary(np.log, lambda x, f: (1 / x, -1 / x**2))
_atan2 = np.arctan2


def _root(x: Array, f: Array) -> tuple[Array, Array]:
    return 0.5 / f, -0.25 / (f * x)


def _logistic(x: Array) -> Array:
    return np.asarray(special.expit(x))


_UNARY = {
    "exp": exp,
    "log": log,
    "sin": _unary(np.sin, lambda x, f: (np.cos(x), -f)),
    "cos": _unary(np.cos, lambda x, f: (-np.sin(x), -f)),
    "tan": _unary(np.tan, lambda x, f: (1 + f**2, 2 * f * (1 + f**2))),
    "tanh": _unary(np.tanh, lambda x, f: (1 - f**2, -2 * f * (1 - f**2))),
    "sinh": _unary(np.sinh, lambda x, f: (np.cosh(x), f)),
    "cosh": _unary(np.cosh, lambda x, f: (np.sinh(x), f)),
    "asin": _unary(np.arcsin, lambda x, f: ((1 - x**2) ** -0.5, x * (1 - x**2) ** -1.5)),
    "acos": _unary(np.arccos, lambda x, f: (-((1 - x**2) ** -0.5), -x * (1 - x**2) ** -1.5)),
    "atan": _unary(np.arctan, lambda x, f: (1 / (1 + x**2), -2 * x / (1 + x**2) ** 2)),
    "asinh": _unary(np.arcsinh, lambda x, f: ((1 + x**2) ** -0.5, -x * (1 + x**2) ** -1.5)),
    "acosh": _unary(np.arccosh, lambda x, f: ((x**2 - 1) ** -0.5, -x * (x**2 - 1) ** -1.5)),
    "atanh": _unary(np.arctanh, lambda x, f: (1 / (1 - x**2), 2 * x / (1 - x**2) ** 2)),
    "sqrt": _unary(np.sqrt, _root),
    "abs": _unary(np.abs, lambda x, f: (np.sign(x), np.zeros(()))),
    "sign": _unary(np.sign, lambda x, f: (np.zeros(()), np.zeros(()))),
    "floor": _unary(np.floor, lambda x, f: (np.zeros(()), np.zeros(()))),
    "softplus": _unary(
        lambda x: np.asarray(np.logaddexp(x, 0.0)),
        lambda x, f: (_logistic(x), _logistic(x) * (1 - _logistic(x))),
    ),
    "logistic": _unary(_logistic, lambda x, f: (f * (1 - f), f * (1 - f) * (1 - 2 * f))),
}


def _where(condition: Any, a: Any, b: Any) -> Any:
    if not isinstance(a, Jet) and not isinstance(b, Jet):
        return np.where(condition, a, b)
    a, b, mask = jet(a), jet(b), np.asarray(condition)

    def chosen(mine: Slopes, its: Slopes, axes: int) -> Slopes:
        if mine is None and its is None:
            return None
        wide = mask.reshape(mask.shape + (1,) * axes)
        return np.where(wide, 0.0 if mine is None else mine, 0.0 if its is None else its)

    return Jet(
        np.where(mask, a.value, b.value), chosen(a.first, b.first, 1), chosen(a.second, b.second, 2), max(a.n, b.n)
    )


def _guard(condition: Any, x: Any) -> Any:
    return _where(condition, x, jet(x).value) if isinstance(x, Jet) else x


def _angle(y: Any, x: Any) -> Any:
    """atan2, by the imaginary part of a logarithm: its derivatives are those of atan(y / x) on either axis."""
    a, b = jet(y), jet(x)
    if a.first is None and b.first is None:
        return np.arctan2(a.value, b.value)
    turned = np.abs(b.value) < np.abs(a.value)
    upper = _where(turned, b, a) / _where(turned, a, b)
    found = _UNARY["atan"](upper)
    found = _where(turned, -found, found)
    return found + (np.arctan2(a.value, b.value) - found.value)


def _unpack(x: Any) -> Any:
    return x if isinstance(x, tuple) else tuple(x.T)


@functools.cache
def jet_arithmetic() -> Any:
    """The arithmetic, with the names of `backends/module/template/arithmetic.py`; without networks and arrays."""
    return SimpleNamespace(
        **_UNARY,
        atan2=_angle,
        minimum=lambda a, b: _where(jet(a).value <= jet(b).value, a, b),
        maximum=lambda a, b: _where(jet(a).value >= jet(b).value, a, b),
        logical_and=np.logical_and,
        logical_or=np.logical_or,
        logical_not=np.logical_not,
        where=_where,
        guard=_guard,
        unpack=_unpack,
        pack=lambda like, parts: Vector(parts),
        column=lambda x: x,
        ahead=lambda x, h, k: x + k * h,
        pi=np.pi,
        inf=np.inf,
        nan=np.nan,
    )


__all__ = ["Jet", "Vector", "jet", "jet_arithmetic"]
