"""The prover of signs is sound, and proves what models need."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import sympy
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gbspec.ir.model import symbol
from gbspec.passes import signs
from gbspec.passes.intervals import REAL, Interval, enclosure
from gbspec.passes.signs import Prover

u, g, K, n = map(symbol, ("u", "g", "K", "n"))
POSITIVE = Interval(0.0, math.inf, True, True)
BOX = {u: Interval(0.0, 10.0), g: Interval(0.0, math.inf, False, True), K: POSITIVE}

PROVED = [
    (sympy.diff(u / (K + u), u), True),
    (sympy.diff(u / (K * (1 + g / K) + u), u), False),
    (-sympy.diff(u / (K * (1 + g / K) + u), g), False),
    (sympy.diff(u**2 / (K**2 + u**2), u), False),
    (1 - sympy.exp(-u / K), False),
    (u * (10 - u), False),
    (10 * u - u**2, False),
    (100 - u**2, False),
    (u**2 - 2 * u + sympy.Rational(11, 10), True),
    (sympy.log(1 + u), False),
    (g + sympy.tanh(g), False),
    (g**2 * sympy.tanh(g) + g * sympy.exp(-g), False),
    (sympy.Max(u - 5, 0), False),
    (sympy.Abs(g - 3) + K, True),
    (sympy.tanh(u) - sympy.tanh(u) ** 3, False),
    (sympy.Piecewise((u, u > 5), (K, True)), False),
    (sympy.floor(u), False),
    (sympy.floor(-u / 24) + sympy.Rational(3, 2), True),
    (g - 24 * sympy.floor(g / 24), False),
    (24 - g + 24 * sympy.floor(g / 24), True),
    (2 + u - K * sympy.floor(u / K), True),
]

NOT_PROVED = [
    (u - 1, False),
    (sympy.diff(u / (K + u + u**2), u), False),
    (u, True),
    (1 / (u - 5), False),
    (sympy.sin(u), False),
    (sympy.log(u), False),
    (g - K, False),
    (sympy.sqrt(u - 1), False),
    (sympy.floor(u), True),
    (g - 24 * sympy.floor(g / 23), False),
]


@pytest.mark.parametrize(("expression", "strict"), PROVED, ids=str)
def test_true_signs_are_proved(expression: sympy.Expr, strict: bool) -> None:
    prover = Prover(BOX)
    assert prover.positive(expression) if strict else prover.nonnegative(expression)


@pytest.mark.parametrize(("expression", "strict"), NOT_PROVED, ids=str)
def test_false_signs_are_not_proved(expression: sympy.Expr, strict: bool) -> None:
    prover = Prover(BOX)
    assert not (prover.positive(expression) if strict else prover.nonnegative(expression))


@pytest.mark.parametrize(
    ("function", "low", "high"),
    [(sympy.acos, -1.0, 0.5), (sympy.asin, -1.0, 0.5), (sympy.atan, -2.0, 1.0), (sympy.cosh, -1.0, 2.0)],
)
def test_the_interval_of_a_function_is_as_narrow_as_its_values(function: Any, low: float, high: float) -> None:
    found = enclosure(function(u), {u: Interval(low, high)})
    values = [float(function(x)) for x in np.linspace(low, high, 31)]
    assert found is not None and (found.low, found.high) == pytest.approx((min(values), max(values)))


def test_a_box_is_halved_up_to_a_number_of_times(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Prover(BOX).positive(sympy.exp(u / 3) - 2 * u / 3 + 0.7)
    monkeypatch.setattr(signs, "BOXES", 2)
    assert not Prover(BOX).positive(sympy.exp(u / 3) - 2 * u / 3 + 0.7)


def test_a_power_of_a_corner_without_a_value_may_be_any() -> None:
    """Such as inf^0, of which every limit is possible."""
    found = enclosure(K**g, {K: Interval(1.0, math.inf, False, True), g: Interval(0.0, 1.0)})
    assert found is not None and (found.low, found.high, found.positive) == (0.0, math.inf, True)
    assert enclosure(K**g, {K: Interval(1.0, 4.0), g: Interval(0.5, 2.0)}) == Interval(1.0, 16.0)


def test_decimal_coefficients_are_divided_without_a_remainder() -> None:
    prover = Prover({K: Interval(0.1, 10.0), g: POSITIVE})
    assert not prover.nonnegative(g - 2.0 * u**2 / (K**2 + u**2))
    assert prover.nonnegative(2.1 - 2.0 * u**2 / (K**2 + u**2))


def made(build: Any, *arguments: sympy.Expr) -> sympy.Expr:
    """The expression, or 1 if it is not a real number."""
    try:
        result = build(*arguments)
    except (ValueError, TypeError, OverflowError):
        return sympy.S.One
    return sympy.S.One if result.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I) else result


def expressions() -> st.SearchStrategy[sympy.Expr]:
    leaves = st.sampled_from([u, g, K, *map(sympy.Integer, range(-3, 4)), sympy.Rational(1, 2), sympy.Float(0.3)])
    unary = [
        sympy.exp,
        sympy.tanh,
        sympy.Abs,
        sympy.log,
        sympy.sqrt,
        sympy.atan,
        sympy.cosh,
        sympy.sin,
        sympy.acos,
        sympy.asinh,
        sympy.floor,
        lambda a: a**2,
        lambda a: a**3,
        lambda a: 1 / a,
    ]
    binary = [
        sympy.Add,
        sympy.Mul,
        lambda a, b: a - b,
        lambda a, b: a / b,
        lambda a, b: a - b * sympy.floor(a / b),
        sympy.Max,
        sympy.Min,
        lambda a, b: sympy.Abs(a) ** b,
    ]
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.tuples(st.sampled_from(unary), inner).map(lambda p: made(*p)),
            st.tuples(st.sampled_from(binary), inner, inner).map(lambda p: made(*p)),
        ),
        max_leaves=8,
    )


def sample(count: int) -> list[dict[sympy.Symbol, float]]:
    rng = np.random.default_rng(0)
    rows = [{u: rng.uniform(0, 10), g: rng.exponential(5), K: rng.exponential(1) + 1e-9} for _ in range(count)]
    corners = [{u: a, g: b, K: c} for a in (0.0, 10.0) for b in (0.0, 1e3) for c in (1e-6, 1e3)]
    return rows + corners


ROWS = sample(30)


def precise(expression: sympy.Expr, row: dict[sympy.Symbol, float]) -> float:
    """The value by 400 digits: a difference of large numbers (x - K*floor(x/K) at 1e175) has none right in doubles."""
    return float(sympy.N(expression.subs({name: sympy.Rational(x) for name, x in row.items()}), 400))


@settings(max_examples=150, deadline=None)
@given(expressions())
@example(sympy.exp(sympy.exp(u)) - K * sympy.floor(sympy.exp(sympy.exp(u)) / K))
@example(sympy.Abs(u) ** sympy.acos(-3))
def test_results_for_random_expressions_are_true(expression: sympy.Expr) -> None:
    """All finite values agree with the enclosure or the proved sign."""
    prover = Prover(BOX)
    found, nonnegative, positive = (
        enclosure(expression, BOX),
        prover.nonnegative(expression),
        prover.positive(expression),
    )
    assert nonnegative or not positive
    function = sympy.lambdify([u, g, K], expression, "math")
    for row in ROWS:
        try:
            value = float(function(row[u], row[g], row[K]))
        except (ZeroDivisionError, ValueError, OverflowError, TypeError):
            continue
        if not math.isfinite(value):
            continue
        low, high = (-math.inf, math.inf) if found is None else (found.low, found.high)
        low = max(low, 0.0) if nonnegative else low
        tolerance = 1e-9 * (1 + abs(value))
        if not low - tolerance <= value <= high + tolerance:
            value = precise(expression, row)
            tolerance = 1e-9 * (1 + abs(value))
        assert low - tolerance <= value <= high + tolerance


def test_without_knowledge_an_expression_may_be_any_number() -> None:
    assert enclosure(n, BOX) == REAL
    assert enclosure(1 / (u - 3), BOX) is None


def test_the_prover_terminates() -> None:
    """A claim that no step can settle costs a bounded number of steps."""
    hard = sum((sympy.sin(k * u + K) ** 2 / (1 + g**k) for k in range(1, 30)), sympy.Float(-1e-3))
    prover = Prover(BOX)
    assert not prover.nonnegative(hard - sympy.Rational(1, 10))
