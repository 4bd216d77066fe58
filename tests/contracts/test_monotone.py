"""The calculus of monotone expressions is sound, and proves the laws that models have."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import sympy
from hypothesis import given, settings

from gbspec.passes.intervals import REAL, Interval
from gbspec.passes.monotone import monotone
from gbspec.passes.signs import Prover
from tests.contracts.helpers import model_of, refused
from tests.contracts.test_signs import BOX, K, expressions, g, n, u

POSITIVE = Interval(0.0, math.inf, True, True)
HERE = {**BOX, n: REAL}

PROVED = [
    # expression, variable, direction
    (sympy.sqrt(sympy.Max(n, 0)) * K, n, 1),
    (sympy.sqrt(u) * sympy.exp(-g), u, 1),
    (sympy.sqrt(u) * sympy.exp(-g), g, -1),
    (sympy.sqrt(sympy.Max(n, 0)) * sympy.Min(u, 3) * K, n, 1),
    (sympy.sqrt(sympy.Max(n, 0)) * sympy.Min(n, 3), u, 1),
    (sympy.Max(n, 0) ** K, n, 1),
    (-sympy.sqrt(sympy.Max(n - 1, 0)), n, -1),
    (K * sympy.sqrt(sympy.Max(n, 0)) * u / (K + u), u, 1),
    (sympy.Max(n, 0) ** sympy.Float(1.5) + sympy.tanh(n), n, 1),
    (sympy.exp(-1 / (K + u)) * (1 + u) ** 2, u, 1),
    (n**3 + sympy.asinh(n), n, 1),
    (sympy.Abs(u) + sympy.cosh(u), u, 1),
    ((1 + u) ** n, g, 1),
    (sympy.Integer(2) ** n, n, 1),
    (sympy.Rational(1, 2) ** n, n, -1),
    (1 / (1 + sympy.sqrt(u)), u, -1),
    ((-1 - u) ** -2, u, -1),
    (sympy.Piecewise((sympy.sqrt(u), g > 1), (2 * u, True)), u, 1),
]

NOT_PROVED = [
    (sympy.sqrt(sympy.Max(n, 0)) * n, n, -1),
    (sympy.sqrt(u) * (5 - u), u, 1),
    (sympy.sqrt(u) * sympy.exp(-u), u, 1),
    (sympy.sqrt(sympy.Max(n, 0)) * g, n, -1),
    (n**2, n, 1),
    (n**2, n, -1),
    (1 / n, n, -1),
    (1 / (u - 5), u, -1),
    (sympy.Piecewise((u, u > 5), (2 * u, True)), u, 1),
    (sympy.sin(u), u, 1),
    (n * sympy.sqrt(u), u, 1),
    (sympy.sqrt(n), n, 1),
    (K**n, n, 1),
    ((u - 5) ** 2, u, 1),
]


@pytest.mark.parametrize(("expression", "variable", "direction"), PROVED, ids=str)
def test_true_directions_are_proved(expression: sympy.Expr, variable: sympy.Symbol, direction: int) -> None:
    assert monotone(Prover(HERE), expression, variable, direction)


@pytest.mark.parametrize(("expression", "variable", "direction"), NOT_PROVED, ids=str)
def test_false_directions_are_not_proved(expression: sympy.Expr, variable: sympy.Symbol, direction: int) -> None:
    assert not monotone(Prover(HERE), expression, variable, direction)


def lines() -> list[tuple[float, float, list[float]]]:
    """Values of `g` and `K`, and rising values of `u`, within the intervals."""
    rng = np.random.default_rng(0)
    rows = [(float(rng.exponential(5)), float(rng.exponential(1)) + 1e-9) for _ in range(6)] + [(0.0, 1e-6)]
    return [(a, b, [0.0, *sorted(map(float, rng.uniform(0, 10, 12))), 10.0]) for a, b in rows]


LINES = lines()


@settings(max_examples=150, deadline=None)
@given(expressions())
def test_directions_of_random_expressions_are_true(expression: sympy.Expr) -> None:
    """Wherever a direction in `u` is proved, values at rising `u` follow it."""
    prover = Prover(BOX)
    proved = [way for way in (1, -1) if monotone(prover, expression, u, way)]
    function = sympy.lambdify([u, g, K], expression, ["math", {"re": float}])  # all are real
    for a, b, rising in LINES if proved else []:
        values = []
        for at in rising:
            try:
                values.append(float(function(at, a, b)))
            except (ZeroDivisionError, ValueError, OverflowError, TypeError):
                continue
        for before, after in pairwise(values):
            if math.isfinite(before) and math.isfinite(after):
                tolerance = 1e-9 * (1 + abs(before) + abs(after))
                assert all(way * (after - before) >= -tolerance for way in proved)


@pytest.mark.parametrize(
    "unknown",
    [
        "unknown q(u in [0, 5]) increasing in u = sqrt(max(u, 0))*nn",
        "unknown q(u) >= 0, increasing in u = sqrt(max(u, 0))*nn",
        "unknown q(u, v) increasing in u, decreasing in v = sqrt(max(u, 0))*exp(-v)*nn",
        "unknown q(u) zero at u = 0, increasing in u = K*sqrt(max(u, 0))*nn",
        "unknown q(u) >= 0, increasing in u = max(u, 0)^k*nn",
        "unknown q(u in [0, 5]) >= 0, increasing in u = min(sqrt(u), 2)*nn",
    ],
)
def test_outflows_are_accepted(unknown: str) -> None:
    assert model_of(unknown).unknowns[0].form is not None


def test_what_is_not_monotone_is_still_refused() -> None:
    assert [d.code for d in refused("unknown q(u in [0, 5]) increasing in u = sqrt(u)*(4 - u)*nn")] == ["GB605"]
