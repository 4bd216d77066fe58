"""Truncated power series in time t and a parameter s along many lines at once, and evaluation of expressions on them.

An array of shape [..., L] holds the coefficients of the L monomials t^i s^j with i + j <= order (and i <= time order).
Everything but the constant term is nilpotent, so a function of a series is its Taylor polynomial at the constant term.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray

from gbspec.arrays import Array, Mask
from gbspec.ir import Expr, Lookup

STEP = 4_000
"""What one product of a coefficient with a series costs beside its multiplications, in multiplications."""

LARGE = 20_000
"""Products of more numbers are faster where the coefficients of a monomial lie side by side in memory."""

Places: TypeAlias = slice | NDArray[np.int64]


class OutOfEffortError(Exception):
    """The budget is spent."""


@dataclass
class Effort:
    """A budget counted in multiplications, not in seconds, so that an answer does not depend on the machine; about
    60 million are done in a second."""

    left: float = math.inf

    def spend(self, multiplications: float) -> None:
        """Raises `OutOfEffortError` when nothing is left."""
        self.left -= multiplications
        if self.left < 0:
            raise OutOfEffortError


@dataclass(frozen=True)
class Algebra:
    """Arithmetic of series up to a total order and an order in time; products spend `effort`."""

    order: int
    time_order: int
    effort: Effort = field(default_factory=Effort, compare=False)

    @cached_property
    def monomials(self) -> tuple[tuple[int, int], ...]:
        """Exponents (of t, of s) of each coefficient; the constant term comes first."""
        pairs = [(i, j) for i in range(self.time_order + 1) for j in range(self.order + 1 - i)]
        return tuple(sorted(pairs, key=lambda p: (p[0] + p[1], p)))

    @cached_property
    def index(self) -> Mapping[tuple[int, int], int]:
        """Position of each monomial."""
        return {monomial: k for k, monomial in enumerate(self.monomials)}

    @cached_property
    def _products(self) -> list[tuple[Places, Places, int]]:
        """For each monomial: the monomials that it can be multiplied with, the products, and how many they are."""
        table = []
        for i, j in self.monomials:
            pairs = [(k, self.index.get((i + a, j + b))) for k, (a, b) in enumerate(self.monomials)]
            kept = [(k, target) for k, target in pairs if target is not None]
            table.append((_places([k for k, _ in kept]), _places([target for _, target in kept]), len(kept)))
        return table

    @property
    def size(self) -> int:
        """The number of coefficients."""
        return len(self.monomials)

    def zeros(self, shape: tuple[int, ...]) -> Array:
        """An array of zeros, in the arithmetic of this algebra."""
        return np.zeros(shape)

    def numbers(self, values: Array | float) -> Array:
        """Numbers in the arithmetic of this algebra."""
        return np.asarray(values, dtype=np.float64)

    def number(self, e: Expr) -> float:
        """The value of an expression without symbols."""
        return float(e)

    def constant(self, value: Array | float) -> Array:
        """A series that does not vary."""
        values = self.numbers(value)
        result = self.zeros((*values.shape, self.size))
        result[..., 0] = values
        return result

    def times(self, a: Array, b: Array) -> Array:
        """The product; leading axes are broadcast."""
        result = self.zeros(np.broadcast_shapes(a.shape, b.shape))
        present = (a.reshape(-1, self.size) != 0).any(axis=0).nonzero()[0]
        if len(present) > 1 and result.size > LARGE:
            b, result = _by_monomial(b), _by_monomial(result)
        for k in present:
            source, target, count = self._products[k]
            self.effort.spend(STEP + result[..., 0].size * count)
            result[..., target] += a[..., k : k + 1] * b[..., source]
        return np.ascontiguousarray(result)

    def compose(self, taylor: Array, a: Array) -> Array:
        """`sum_k taylor[..., k] z^k` for z the series without its constant term."""
        z = a.copy()
        z[..., 0] = 0.0
        result = self.constant(taylor[..., self.order])
        for k in range(self.order - 1, -1, -1):
            result = self.times(result, z)
            result[..., 0] += taylor[..., k]
        return result

    def integral(self, a: Array) -> Array:
        """The integral over time from 0."""
        result = self.zeros(a.shape)
        for k, (i, j) in enumerate(self.monomials):
            target = self.index.get((i + 1, j))
            if target is not None:
                result[..., target] = a[..., k] / (i + 1)
        return result

    # ------------------------------------------------------------------------------------------ elementary functions

    @cached_property
    def _factorials(self) -> Array:
        """0!, 1!, ..., order!; as real numbers, since 21! is more than a whole number of 64 bits can be."""
        return np.cumprod([1.0, *range(1, self.order + 1)])

    def _taylor(self, values: Array, coefficients: Callable[[float], list[float]]) -> Array:
        flat = [[float(c) for c in coefficients(float(v))] for v in np.ravel(values)]
        return np.reshape(np.array(flat), (*np.shape(values), self.order + 1))

    def exp(self, a: Array) -> Array:
        """e^a."""
        return self.compose(np.exp(a[..., :1]) / self._factorials, a)

    def power(self, a: Array, exponent: float) -> Array:
        """a^exponent for a real exponent."""
        if exponent == int(exponent) and 0 <= exponent <= 8:
            result = self.constant(np.ones(a.shape[:-1]))
            for _ in range(int(exponent)):
                result = self.times(result, a)
            return result
        binomial, terms = 1.0, []
        for k in range(self.order + 1):
            terms.append(binomial * np.power(a[..., 0], exponent - k))
            binomial *= (exponent - k) / (k + 1)
        return self.compose(np.stack(terms, axis=-1), a)

    def log(self, a: Array) -> Array:
        """The natural logarithm."""
        terms = [np.log(a[..., 0])] + [-((-1.0) ** k) / k * a[..., 0] ** -k for k in range(1, self.order + 1)]
        return self.compose(np.stack(terms, axis=-1), a)

    def wave(self, a: Array, shift: int) -> Array:
        """sin (shift 0) or cos (shift 1)."""
        quarters = math.pi / 2 * (shift + np.arange(self.order + 1))
        return self.compose(np.sin(a[..., :1] + quarters) / self._factorials, a)

    def general(self, name: str, a: Array) -> Array:
        """Any other function of one argument, its Taylor coefficients by mpmath."""
        import mpmath

        function = getattr(mpmath, name)
        return self.compose(self._taylor(a[..., 0], lambda v: list(mpmath.taylor(function, v, self.order))), a)


@dataclass
class Evaluation:
    """Expressions on series: `values` has the series of each symbol, shape [lines, L]."""

    algebra: Algebra
    values: Mapping[sympy.Symbol, Array]
    lines: int
    _memo: dict[Expr, Array] = field(default_factory=dict)

    def __call__(self, expression: Expr) -> Array:
        """The series of an expression, shape [lines, L]."""
        if expression not in self._memo:
            self._memo[expression] = self._evaluate(expression)
        return self._memo[expression]

    def _evaluate(self, e: Expr) -> Array:
        algebra = self.algebra
        if e.is_Symbol:
            return self.values[e]
        if e.is_number:
            return algebra.constant(np.full(self.lines, algebra.number(e)))
        if e.is_Add:
            return np.asarray(np.sum([self(part) for part in e.args], axis=0))
        if e.is_Mul:
            result = self(e.args[0])
            for part in e.args[1:]:
                result = algebra.times(result, self(part))
            return result
        if e.is_Pow:
            if e.exp.is_number:
                return algebra.power(self(e.base), algebra.number(e.exp))
            return algebra.exp(algebra.times(self(e.exp), algebra.log(self(e.base))))
        if isinstance(e, sympy.Piecewise):
            return self._piecewise(e)
        return self._function(e)

    def _function(self, e: Expr) -> Array:
        algebra, arguments = self.algebra, [self(part) for part in e.args]
        if isinstance(e, Lookup):
            return self._lookup(e, arguments)
        a = arguments[0]
        match e.func.__name__:
            case "exp":
                return algebra.exp(a)
            case "log":
                return algebra.log(a)
            case "sin":
                return algebra.wave(a, 0)
            case "cos":
                return algebra.wave(a, 1)
            case "Abs":
                return np.sign(a[..., :1]) * a
            case "sign":
                return algebra.constant(np.sign(a[..., 0]))
            case "floor":
                return algebra.constant(np.floor(a[..., 0]))
            case "Heaviside":
                return algebra.constant((a[..., 0] > 0).astype(float))
            case "Min" | "Max":
                better = np.less if e.func.__name__ == "Min" else np.greater
                for b in arguments[1:]:
                    a = np.where(better(a[..., :1], b[..., :1]), a, b)
                return a
            case "atan2":
                result = algebra.general("atan", algebra.times(a, algebra.power(arguments[1], -1.0)))
                result[..., 0] = np.arctan2(a[..., 0], arguments[1][..., 0])
                return result
            case name:
                return algebra.general(str(name), a)

    def _lookup(self, e: Lookup, arguments: list[Array]) -> Array:
        """A table at series: the polynomial of the piece in which the constant terms lie."""
        algebra = self.algebra
        middles = [a[..., 0] for a in arguments]
        changes = [a - algebra.constant(m) for a, m in zip(arguments, middles, strict=True)]
        result = algebra.constant(np.zeros(self.lines))
        for powers in np.ndindex(*[min(e.curve.degree, algebra.order) + 1] * len(arguments)):
            order = tuple(have + more for have, more in zip(e.order, powers, strict=True))
            factor = e.curve.value(order, *middles) / math.prod(map(math.factorial, powers))
            term = algebra.constant(factor)
            for change, power in zip(changes, powers, strict=True):
                for _ in range(power):
                    term = algebra.times(term, change)
            result = result + term
        return result

    def _piecewise(self, e: Expr) -> Array:
        result = np.full((self.lines, self.algebra.size), np.nan)
        for value, condition in reversed(e.args):
            result = np.where(self.condition(condition)[..., None], self(value), result)
        return result

    def condition(self, condition: sympy.Basic) -> Mask:
        """Whether a condition holds, for each line."""
        if condition in (sympy.true, sympy.false):
            return np.full(self.lines, condition == sympy.true)
        if isinstance(condition, sympy.Not):
            return ~self.condition(condition.args[0])
        if isinstance(condition, sympy.And | sympy.Or):
            parts = [self.condition(part) for part in condition.args]
            return np.asarray(np.all(parts, axis=0) if isinstance(condition, sympy.And) else np.any(parts, axis=0))
        left, right = self(condition.args[0])[..., 0], self(condition.args[1])[..., 0]
        comparisons = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal}
        compare = comparisons.get(condition.rel_op, np.equal)
        return np.asarray(compare(left, right))


def _places(numbers: list[int]) -> Places:
    """Places along an axis: a slice, which copies nothing, where they follow one another."""
    first, end = numbers[0], numbers[-1] + 1
    return slice(first, end) if numbers == list(range(first, end)) else np.array(numbers)


def _by_monomial(a: Array) -> Array:
    """The same array, shape [..., L], with the coefficients of each monomial side by side in memory."""
    return np.moveaxis(np.ascontiguousarray(np.moveaxis(a, -1, 0)), 0, -1)
