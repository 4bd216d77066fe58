"""From text to sympy: exact numbers, cheap powers, scopes of functions and postulates."""

from __future__ import annotations

import math

import pytest
import sympy
from hypothesis import example, given
from hypothesis import strategies as st

from gbspec.diagnostics import Findings, Source
from gbspec.ir.model import NN, symbol, unknown_function
from gbspec.lower import lower_expression
from gbspec.lower.expressions import number, power, relation
from gbspec.syntax.parser import parse_expression
from tests.texts import codes, model_of

x, k, y = symbol("x"), symbol("k"), symbol("y")
DECAY = "model m\nstate x\nlearn k = 1\nx' = {}\nobserve x\n"


def rhs(expression: str) -> sympy.Expr:
    return model_of(DECAY.format(f"{expression} + 0*k*x")).balances[0]


@given(st.floats(allow_nan=False, allow_infinity=False, min_value=0))
def test_every_float_keeps_its_value(value: float) -> None:
    assert float(number(repr(value))) == value


@given(st.integers(0, 2**60))
@example(2**53)
@example(2**53 + 1)
def test_whole_numbers_are_exact_while_they_are_doubles(value: int) -> None:
    assert float(number(str(value))) == float(value)
    assert number(str(value)).is_Integer == (value <= 2**53)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-x^2", -(x**2)),
        ("2^3^2*x", 512 * x),
        ("x - 1 - k", x - 1 - k),
        ("8/2/2*x", 2 * x),
        ("x^2.0", x**2),
        ("x^0.5", sympy.sqrt(x)),
        ("1/3*x", sympy.Rational(1, 3) * x),
        ("log10(x)", sympy.log(x) / sympy.log(10)),
        ("atan2(x, k)", sympy.atan2(x, k)),
        ("abs(x)", sympy.Abs(x)),
        ("floor(x)", sympy.floor(x)),
        ("ceil(x/k)", -sympy.floor(-x / k)),
        ("mod(x, k)", x - k * sympy.floor(x / k)),
        ("x*(floor(-1.5) + 10*ceil(-1.5) + 100*mod(-7, 3) + 1000*mod(7, -3))", -1812 * x),
        ("x*pi", x * sympy.pi),
        ("(x + k)*(x - k)", (x + k) * (x - k)),
        ("if(1 < 2, x, k)", x),
    ],
)
def test_expression(text: str, expected: sympy.Expr) -> None:
    assert rhs(text) == expected


def test_conditional_is_piecewise() -> None:
    value = rhs("if(x > k and not x > 5, x, k)")
    assert value.subs({x: 3, k: 1}) == 3
    assert value.subs({x: 6, k: 1}) == 1
    assert value.subs({x: 0, k: 1}) == 1


def test_a_comparison_is_decided_at_once_only_between_numbers() -> None:
    assert relation(">", sympy.Integer(2), sympy.Integer(1)) is sympy.true
    for left, right in ((x**2, sympy.Integer(-1)), (sympy.Integer(-1), x**2)):
        assert not isinstance(relation(">" if left.has(x) else "<", left, right), sympy.logic.boolalg.BooleanAtom)


@pytest.mark.parametrize("text", ["9^9^9^2*x", "(1/3)^1000000*x", "(2*x)^1000000", "7^(1000000/3)*x"])
def test_large_powers_are_cheap(text: str) -> None:
    found = codes(DECAY.format(text + " + k"))
    assert found in ([], ["GB223"])


@pytest.mark.parametrize("factor", [2, -3, sympy.Rational(1, 3)])
def test_the_factor_of_a_large_power_becomes_a_float(factor: sympy.Expr) -> None:
    found = power(factor * x, sympy.Integer(5000))
    assert found.has(sympy.Float) and all(n.is_Float or abs(n) <= 5000 for n in found.atoms(sympy.Number))


def test_exact_numbers_too_long_to_print_become_floats() -> None:
    total = rhs("+".join(f"1/{n}" for n in range(1, 200)) + "*x")
    numbers = total.atoms(sympy.Rational)
    assert all(abs(n.q).bit_length() <= 64 for n in numbers)


def test_long_sums_do_not_exhaust_the_stack() -> None:
    value = rhs(" + ".join(["x"] * 5000))
    assert value == 5000 * x


def test_functions_are_expanded_and_arguments_shadow() -> None:
    model = model_of(
        "model m\nstate x\nstate y\nfunction f(y, z) = y^2 + z\nfunction g(x) = f(x + 1, y)\n"
        "x' = g(3*y)\ny' = f(x, x)\nobserve x\n"
    )
    assert model.balances == ((3 * y + 1) ** 2 + y, x**2 + x)


def test_unknown_without_parentheses_is_applied_to_its_names() -> None:
    model = model_of("model m\nstate x\nstate y\nunknown phi(x, y)\nx' = phi\ny' = phi(y, 2*x)\nobserve x\n")
    phi = unknown_function("phi")
    assert model.balances == (phi(x, y), phi(y, 2 * x))


def test_unknown_in_a_function_means_the_arguments_there() -> None:
    model = model_of("model m\nstate x\nunknown phi(x)\nfunction f(x) = 2*phi\nx' = f(x + 1)\nobserve x\n")
    assert model.balances[0] == 2 * unknown_function("phi")(x + 1)


@pytest.mark.parametrize(
    ("postulate", "neutral"),
    [
        ("u*nn", 1.0),
        ("nn", 0.0),
        ("u + nn", 0.0),
        ("-nn*u", 1.0),
        ("u/nn", 1.0),
        ("u*(1 + nn)", 0.0),
        ("u*exp(nn)", 0.0),
        ("u*nn^2", 1.0),
        ("u*nn + nn", 0.0),
        ("u*nn - 2*nn", 1.0),
        ("2^nn", 0.0),
    ],
)
def test_neutral_correction(postulate: str, neutral: float) -> None:
    model = model_of(f"model m\nstate x\nunknown f(u) = {postulate}\nx' = f(x)\nobserve x\n")
    (unknown,) = model.unknowns
    assert unknown.neutral == neutral
    assert unknown.postulate.has(NN)


def test_an_argument_does_not_capture_a_constant_behind_a_let() -> None:
    model = model_of(
        "model m\nstate x\nlearn K = 2\nlet half = K/2\nunknown f(K) = half*K*nn\nx' = f(x)\nobserve x\n"
        "truth f(K) = half + K\n"
    )
    (argument,) = model.networks[0].arguments
    assert argument.name != "K"
    assert model.unknowns[0].postulate == symbol("K") / 2 * argument.symbol * NN
    (truth,) = model.truth_functions
    assert truth.value == symbol("K") / 2 + symbol(truth.parameters[0])
    assert truth.parameters[0] != "K"


def test_what_simplifies_to_a_non_finite_number_is_reported() -> None:
    assert codes_lowered("k/(x - x)") == ["GB223"]
    assert codes_lowered("k*sqrt(-1 - x^2 + x^2)") == ["GB223"]


def codes_lowered(expression: str) -> list[str]:
    from gbspec.lower import lower
    from tests.texts import checked

    result, findings = checked(DECAY.format(expression))
    assert result is not None
    lower(result, findings)
    return [d.code for d in findings]


def test_command_line_expression() -> None:
    model = model_of("model m\nstate x2\nlearn k = 1\nunknown f(a)\nx2' = k*f(x2)\nobserve x2\n")

    def lowered(text: str) -> tuple[sympy.Expr, list[str]]:
        findings = Findings()
        expression = parse_expression(Source("--reject", text), findings)
        assert expression is not None
        return lower_expression(expression, model, findings), [d.code for d in findings]

    x2 = symbol("x2")
    condition, found = lowered("x2 > 4")
    assert not found
    assert condition == sympy.StrictGreaterThan(x2, 4, evaluate=False)
    assert lowered("k*x2 + f(t)")[0] == k * x2 + unknown_function("f")(symbol("t"))
    assert lowered("x3 > 4")[1] == ["GB201"]
    assert lowered("f(1, 2)")[1] == ["GB207"]
    assert lowered("g(1)")[1] == ["GB201"]


def test_constants_are_doubles() -> None:
    model = model_of("model m\nstate x\nconst a = 1/(7.3*0.68)\nconst b = exp(a)^2\nx' = -a*b*x\nobserve x\n")
    assert [c.value for c in model.constants] == [1 / (7.3 * 0.68), math.exp(1 / (7.3 * 0.68)) ** 2]
