"""Interval arithmetic on sympy expressions: encloses the values of an expression for symbols in given intervals.

Ends are floats and may be open, so that `x > 0` differs from `x >= 0`. Ends are not rounded outwards: a proof holds up
to rounding in double precision, like the evaluation that it is about.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import sympy

from gbspec.ir import Expr, Lookup, Range, logistic, softplus


@dataclass(frozen=True)
class Interval:
    """From `low` to `high`; an end that is marked open (infinite ones always are) is not reached."""

    low: float
    high: float
    low_open: bool = False
    high_open: bool = False

    @property
    def positive(self) -> bool:
        """Whether every number in it is > 0."""
        return self.low > 0 or (self.low == 0 and self.low_open)

    @property
    def nonnegative(self) -> bool:
        """Whether every number in it is >= 0."""
        return self.low >= 0

    def __neg__(self) -> Interval:
        return Interval(-self.high, -self.low, self.high_open, self.low_open)

    def __add__(self, other: Interval) -> Interval:
        return Interval(
            self.low + other.low,
            self.high + other.high,
            self.low_open or other.low_open,
            self.high_open or other.high_open,
        )

    def __mul__(self, other: Interval) -> Interval:
        return _hull(_times(a, b) for a in self._ends() for b in other._ends())

    def _ends(self) -> tuple[tuple[float, bool], tuple[float, bool]]:
        return (self.low, self.low_open), (self.high, self.high_open)


REAL = Interval(-math.inf, math.inf, True, True)
Box = Mapping[sympy.Symbol, Interval]


def of_range(range_: Range | None, *, strict: bool = False) -> Interval:
    """A range as an interval; with `strict` its ends are not reached."""
    if range_ is None:
        return REAL
    low, high = range_.low, range_.high
    return Interval(low, high, strict or math.isinf(low), strict or math.isinf(high))


def _times(a: tuple[float, bool], b: tuple[float, bool]) -> tuple[float, bool]:
    if a[0] == 0 or b[0] == 0:
        reached = (a[0] == 0 and not a[1]) or (b[0] == 0 and not b[1])
        return 0.0, not reached
    return a[0] * b[0], a[1] or b[1]


def _hull(ends: Iterable[tuple[float, bool]]) -> Interval:
    """The smallest interval with these ends; an end is reached if one of the equal candidates is."""
    known = list(ends)
    low, high = min(v for v, _ in known), max(v for v, _ in known)
    low_open = all(is_open for v, is_open in known if v == low)
    return Interval(low, high, low_open, all(is_open for v, is_open in known if v == high))


def enclosure(expression: Expr, box: Box) -> Interval | None:
    """An interval that holds every value of the expression; None if it may be undefined or no rule applies."""
    if isinstance(expression, sympy.Symbol):
        return box.get(expression, REAL)
    if not expression.free_symbols:
        return _number(expression)
    if isinstance(expression, sympy.Piecewise):
        branches = [enclosure(value, box) for value, _ in expression.args]
        known = [branch for branch in branches if branch is not None]
        if len(known) < len(branches) or expression.args[-1][1] != sympy.true:
            return None
        return _hull(end for branch in known for end in branch._ends())
    terms = _with_fractions(expression.args) if isinstance(expression, sympy.Add) else expression.args
    parts = [enclosure(argument, box) for argument in terms]
    inner = [part for part in parts if part is not None]
    if len(inner) < len(parts):
        return None
    return _combined(expression, inner)


class _Fraction(sympy.Function):  # type: ignore[misc]  # sympy is untyped
    """What a number is above the whole number below it."""


def _with_fractions(terms: tuple[Expr, ...]) -> tuple[Expr, ...]:
    """The terms of a sum, those of each `mod(x, y) = x - y*floor(x/y)` as `y` times a fraction: together they are
    enclosed far better than one by one."""
    for term in terms:
        for step in term.args if isinstance(term, sympy.Mul) else (term,):
            whole = -term / step * step.args[0] if isinstance(step, sympy.floor) else None
            if whole is not None and whole in terms:
                rest = tuple(other for other in terms if other not in (term, whole))
                return (*_with_fractions(rest), -term / step * _Fraction(step.args[0]))
    return terms


def _number(expression: Expr) -> Interval | None:
    try:
        value = float(expression)
    except (TypeError, ValueError, OverflowError):
        return None
    return Interval(value, value) if math.isfinite(value) else None


def _combined(expression: Expr, parts: list[Interval]) -> Interval | None:
    kind = type(expression)
    if isinstance(expression, Lookup):
        return None if expression.curve.outside == "error" or any(expression.order) else _table(expression, parts)
    if kind is sympy.Add:
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return None if math.isnan(total.low) or math.isnan(total.high) else total
    if kind is sympy.Mul:
        product = parts[0]
        for part in parts[1:]:
            product = product * part
        return product
    if kind is sympy.Pow:
        return _power(parts[0], parts[1], expression.exp)
    if kind is sympy.Max:
        return _extremum(parts, max)
    if kind is sympy.Min:
        return _extremum(parts, min)
    if kind in INCREASING:
        return _mapped(parts[0], *INCREASING[kind])
    if kind is sympy.acos:
        arc = _mapped(parts[0], math.asin, -1.0, 1.0)
        return None if arc is None else -arc + Interval(math.pi / 2, math.pi / 2)
    if kind is sympy.Abs:
        return _absolute(parts[0])
    if kind is sympy.cosh:
        size = _absolute(parts[0])
        return _mapped(size, _safe(math.cosh), 0.0, math.inf)
    if kind in (sympy.sin, sympy.cos):
        return Interval(-1.0, 1.0)
    if kind is sympy.sign:
        return _mapped(parts[0], lambda x: float((x > 0) - (x < 0)), -math.inf, math.inf, keeps=False)
    if kind is _Fraction:
        return Interval(0.0, 1.0, False, True)
    if kind is sympy.floor:
        return _mapped(parts[0], _floor, -math.inf, math.inf, keeps=False)
    if kind is sympy.Heaviside:
        return Interval(0.0, 1.0)
    return None


def _table(expression: Lookup, parts: list[Interval]) -> Interval:
    """The values of a table: at the ends where it is monotone, else those of the whole table."""
    curve, (part, *others) = expression.curve, parts
    way = curve.direction(0)
    if others or not way:
        return Interval(*curve.bounds)
    ends = [float(curve.value((0,), x)) for x in (part.low, part.high)]
    return Interval(min(ends), max(ends))


def _floor(x: float) -> float:
    return x if math.isinf(x) else float(math.floor(x))


def _safe(function: Callable[[float], float]) -> Callable[[float], float]:
    """The function with infinities for overflow and for poles at the ends of its domain."""

    def evaluate(x: float) -> float:
        try:
            return function(x)
        except OverflowError:
            return math.inf if x > 0 else -math.inf
        except ValueError:
            return -math.inf if x <= 0 else math.inf

    return evaluate


def _exp(x: float) -> float:
    return math.inf if x > 709 else math.exp(x)


def _logistic(x: float) -> float:
    return 1 / (1 + _exp(-x))


def _softplus(x: float) -> float:
    return x if x > 40 else math.log1p(_exp(x))


INCREASING: dict[type[sympy.Basic], tuple[Callable[[float], float], float, float]] = {
    sympy.exp: (_exp, -math.inf, math.inf),
    sympy.tanh: (math.tanh, -math.inf, math.inf),
    sympy.sinh: (_safe(math.sinh), -math.inf, math.inf),
    sympy.atan: (math.atan, -math.inf, math.inf),
    sympy.asinh: (math.asinh, -math.inf, math.inf),
    sympy.asin: (math.asin, -1.0, 1.0),
    sympy.acosh: (math.acosh, 1.0, math.inf),
    softplus: (_softplus, -math.inf, math.inf),
    logistic: (_logistic, -math.inf, math.inf),
    sympy.log: (_safe(math.log), 0.0, math.inf),
    sympy.atanh: (_safe(math.atanh), -1.0, 1.0),
}
"""Increasing functions with the ends of their domains."""


def _mapped(
    part: Interval, function: Callable[[float], float], low: float, high: float, *, keeps: bool = True
) -> Interval | None:
    """The image under an increasing function; None if the interval leaves the domain."""
    if part.low < low or part.high > high:
        return None
    poles = function in (INCREASING[sympy.log][0], INCREASING[sympy.atanh][0])
    if poles and ((part.low == low and not part.low_open) or (part.high == high and not part.high_open)):
        return None
    return Interval(function(part.low), function(part.high), keeps and part.low_open, keeps and part.high_open)


def _extremum(parts: list[Interval], choose: Callable[[list[float]], float]) -> Interval:
    low, high = choose([p.low for p in parts]), choose([p.high for p in parts])
    return Interval(
        low,
        high,
        all(p.low_open for p in parts if p.low == low),
        all(p.high_open for p in parts if p.high == high),
    )


def _absolute(part: Interval) -> Interval:
    if part.low >= 0:
        return part
    if part.high <= 0:
        return -part
    ends = _hull(((-part.low, part.low_open), (part.high, part.high_open)))
    return Interval(0.0, ends.high, False, ends.high_open)


def _reciprocal(part: Interval) -> Interval | None:
    if part.positive:
        high = math.inf if part.low == 0 else 1 / part.low
        return Interval(0.0 if math.isinf(part.high) else 1 / part.high, high, part.high_open, part.low_open)
    if (-part).positive:
        negative = _reciprocal(-part)
        return None if negative is None else -negative
    return None


def _power(base: Interval, exponent: Interval, exact: Expr) -> Interval | None:
    if exact.is_Integer:
        return _integer_power(base, int(exact))
    if base.low < 0 or (base.low == 0 and not base.low_open and exponent.low < 0):
        return None
    ends = [(_real_power(b, e), b_open or e_open) for b, b_open in base._ends() for e, e_open in exponent._ends()]
    if any(math.isnan(value) for value, _ in ends):  # a corner such as inf^0: any power of what is here is possible
        return Interval(0.0, math.inf, base.positive, True)
    # x^y is monotone in each of x and y on x > 0, so the extremes are at corners; it is positive where x is.
    hull = _hull(ends)
    if base.positive and hull.low == 0:
        return Interval(0.0, hull.high, True, hull.high_open)
    return hull


def _integer_power(base: Interval, n: int) -> Interval | None:
    if n < 0:
        positive = _integer_power(base, -n)
        return None if positive is None else _reciprocal(positive)
    if n % 2 == 0:
        base = _absolute(base)
    return Interval(_whole_power(base.low, n), _whole_power(base.high, n), base.low_open, base.high_open)


def _whole_power(x: float, n: int) -> float:
    try:
        return float(x) ** n
    except OverflowError:
        return math.inf if x > 0 or n % 2 == 0 else -math.inf


def _real_power(x: float, y: float) -> float:
    if (x == 1 and math.isinf(y)) or (math.isinf(x) and y == 0):
        return math.nan
    try:
        return math.pow(x, y)
    except OverflowError:
        return math.inf
    except ValueError:
        return math.inf
