"""The table of derivative rules compared with finite differences, torch's differentiation of the generated module, and
the series of identifiability, operation by operation."""

from __future__ import annotations

import math

import numpy as np
import pytest
import sympy
import torch

from gbspec.backends.module import load_module
from gbspec.backends.module.template.arithmetic import _torch_arithmetic
from gbspec.diagnostics import Defect
from gbspec.ir.derivatives import UNARY, derivative, partials
from gbspec.ir.forms import logistic, softplus
from gbspec.ir.model import Channel, Initial, Model, State, symbol
from gbspec.passes.identifiability.series import Algebra, Evaluation

X, Y, Z = symbol("x"), symbol("y"), symbol("z")
POINTS = [(0.3, 0.8, 0.5), (0.7, 0.2, 0.9), (0.55, 0.35, 0.15)]

OPERATIONS: dict[str, sympy.Expr] = {
    **{function.__name__: function(X) for function in UNARY if function is not sympy.acosh},
    "acosh": sympy.acosh(1 + X),
    "sum": X + 2 * Y - Z,
    "product": X * Y * Z,
    "quotient": X / Y,
    "root": sympy.sqrt(X),
    "square": X**2,
    "power": X ** sympy.Float(2.5),
    "negative power": X ** sympy.Rational(-3, 2),
    "exponent": sympy.Integer(2) ** X,
    "general power": X**Y,
    "atan2": sympy.atan2(X, Y),
    "max": sympy.Max(X, Y, evaluate=False),
    "min": sympy.Min(X, Y, evaluate=False),
    "max of three": sympy.Max(X, Y, Z, evaluate=False),
    "min of three": sympy.Min(X, Y, Z, evaluate=False),
    "choice": sympy.Piecewise((sympy.log(X) * Y, X > Y), (X**2, True), evaluate=False),
    "within": sympy.Max(sympy.sin(X * Y), sympy.exp(-Y) / X, evaluate=False),
}

# Where a convention is stated: the expression, the point, and the slopes by x, y and z.
KINKS: dict[str, tuple[sympy.Expr, tuple[float, float, float], tuple[float, float, float]]] = {
    "abs": (sympy.Abs(X), (0.0, 1.0, 1.0), (0.0, 0.0, 0.0)),
    "sign": (sympy.sign(X), (0.0, 1.0, 1.0), (0.0, 0.0, 0.0)),
    "floor": (sympy.floor(X), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)),
    "alternating": (sympy.Integer(-1) ** sympy.floor(X) * X, (3.5, 1.0, 1.0), (-1.0, 0.0, 0.0)),
    "remainder": (X - Y * sympy.floor(X / Y), (-7.5, 2.0, 1.0), (1.0, 4.0, 0.0)),
    "max": (OPERATIONS["max"], (0.4, 0.4, 1.0), (0.5, 0.5, 0.0)),
    "min": (OPERATIONS["min"], (0.4, 0.4, 1.0), (0.5, 0.5, 0.0)),
    "max of three": (OPERATIONS["max of three"], (0.4, 0.4, 0.4), (0.25, 0.25, 0.5)),
    "power 0": (OPERATIONS["general power"], (0.5, 0.0, 1.0), (0.0, math.log(0.5), 0.0)),
    "0 to a power": (OPERATIONS["general power"], (0.0, 2.0, 1.0), (0.0, 0.0, 0.0)),
    "the number 0 to a power": (sympy.Pow(0, Y, evaluate=False) + X, (0.5, 2.0, 1.0), (1.0, 0.0, 0.0)),
    "choice": (OPERATIONS["choice"], (0.4, 0.4, 1.0), (0.8, 0.0, 0.0)),
}


def slopes(expression: sympy.Expr, point: tuple[float, ...]) -> list[float]:
    """The table's derivatives by x, y and z at a point."""
    at = dict(zip((X, Y, Z), map(sympy.Float, point), strict=True))
    return [float(derivative(expression, s).subs(at).evalf()) for s in (X, Y, Z)]


def by_torch(expression: sympy.Expr, point: tuple[float, ...]) -> list[float]:
    """Torch's derivatives through the module generated for a model whose first balance is the expression."""
    states = tuple(State(name, initial=Initial("learn")) for name in ("x", "y", "z"))
    model = Model("m", states=states, balances=(expression, X, Y), channels=(Channel("x", value=X, state=0),))
    state = torch.tensor(point, dtype=torch.float64, requires_grad=True)
    rates = load_module(model).equations.rhs(_torch_arithmetic(), torch.tensor(0.0), state, (), (), (), ())
    rate = rates[..., 0]
    if not rate.requires_grad:
        return [0.0, 0.0, 0.0]
    (found,) = torch.autograd.grad(rate, state)
    return [float(g) for g in found]


@pytest.mark.parametrize("name", OPERATIONS)
def test_the_table_has_the_slopes_that_torch_takes(name: str) -> None:
    for point in POINTS:
        assert slopes(OPERATIONS[name], point) == pytest.approx(by_torch(OPERATIONS[name], point), rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("name", KINKS)
def test_conventions_at_kinks_are_torchs(name: str) -> None:
    expression, point, expected = KINKS[name]
    assert slopes(expression, point) == pytest.approx(expected, rel=1e-14, abs=0)
    assert by_torch(expression, point) == pytest.approx(expected, rel=1e-14, abs=0)


@pytest.mark.parametrize("name", OPERATIONS)
def test_the_table_has_the_slopes_that_differences_have(name: str) -> None:
    """Compares with central differences of the values to 40 digits, which use no derivative rule."""
    expression, h = OPERATIONS[name], sympy.Float(10, 40) ** -12
    at = dict(zip((X, Y, Z), POINTS[0], strict=True))
    for place, symbol_ in enumerate((X, Y, Z)):
        ends = [
            expression.subs({s: sympy.Float(v, 40) + (d if s == symbol_ else 0) for s, v in at.items()}).evalf(40)
            for d in (h, -h)
        ]
        assert slopes(expression, POINTS[0])[place] == pytest.approx(float((ends[0] - ends[1]) / (2 * h)), rel=1e-12)


# These occur only in the forms of contracts, which the identifiability analysis does not use.
FORMS_ALONE = (softplus.__name__, logistic.__name__)


@pytest.mark.parametrize("name", [name for name in OPERATIONS if name not in FORMS_ALONE])
def test_the_series_of_identifiability_follow_the_table(name: str) -> None:
    """The series of f(x(t), y(t), z(t)), differentiated by t, is the sum of the table's slopes times x', y', z'."""
    rng, algebra, expression = np.random.default_rng(1), Algebra(6, 6), OPERATIONS[name]
    series = {}
    for s, start in zip((X, Y, Z), POINTS[0], strict=True):
        series[s] = algebra.constant(np.full(1, start))
        for k in range(1, 7):
            series[s][..., algebra.index[k, 0]] = rng.uniform(-0.2, 0.2)
    evaluation = Evaluation(algebra, series, 1)
    whole = evaluation(expression)
    chained = sum(
        algebra.times(evaluation(derivative(expression, s)), in_time(algebra, series[s]))
        for s in (X, Y, Z)
        if s in expression.free_symbols
    )
    expected, found = in_time(algebra, whole), np.asarray(chained)
    known = [algebra.index[k, 0] for k in range(6)]  # the last is cut off
    assert np.isfinite(expected).all()
    assert found[0, known] == pytest.approx(expected[0, known], rel=1e-9, abs=1e-10)


def in_time(algebra: Algebra, series: np.ndarray) -> np.ndarray:
    """The derivative of a series by t."""
    out = np.zeros_like(series)
    for k in range(6):
        out[..., algebra.index[k, 0]] = (k + 1) * series[..., algebra.index[k + 1, 0]]
    return out


def test_a_node_without_a_rule_is_a_defect() -> None:
    with pytest.raises(Defect, match="erf"):
        partials(sympy.erf(X))
    with pytest.raises(Defect, match="gamma"):
        derivative(2 * sympy.gamma(X) + Y, X)


def test_what_does_not_vary_has_no_slope() -> None:
    assert derivative(sympy.Piecewise((Y, X > 0), (2, True), evaluate=False), X) == 0
    assert derivative(sympy.erf(Y) + X, X) == 1
