"""The printer: texts of expressions, their values, safe names; every kind of node is tested."""

from __future__ import annotations

import inspect
import keyword
import math
import re

import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st

from gbspec.backends.printing import Assignment, Names, NetworkCall, Program, PythonPrinter, TextPrinter, identifier
from gbspec.backends.printing import printer as printer_module
from gbspec.backends.printing.nodes import Guard, Where, temporary
from gbspec.backends.printing.printer import RECIPROCAL, RELATIONS, UNARY
from gbspec.diagnostics import Defect
from gbspec.ir.model import Argument, Intermediate, Model, Network, State, symbol, unknown_function
from tests import strategies

a, b, c, x = map(symbol, ("a", "b", "c", "x"))
PYTHON = PythonPrinter(lambda symbol: symbol.name)


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (a + b - c, "a + b - c"),
        (-a, "-a"),
        (b - a, "b - a"),
        (-a - b, "-a - b"),
        (a - (b - c) * 2, "a - 2*b + 2*c"),
        (-a * b, "-a*b"),
        ((a + b) * c, "c*(a + b)"),
        (a / b, "a/b"),
        (1 / a, "1/a"),
        (a / (b * c), "a/(b*c)"),
        (a / (b + c), "a/(b + c)"),
        (-a / b, "-a/b"),
        (a * sympy.Rational(2, 3), "2*a/3"),
        (-a / 3, "-a/3"),
        (sympy.Rational(1, 3), "1/3"),
        (sympy.Rational(-1, 3) + a, "a - 1/3"),
        (a**2, "a**2"),
        (-(a**2), "-a**2"),
        ((-a) ** 3, "-a**3"),
        ((a + b) ** 2, "(a + b)**2"),
        (a ** (-2), "1/a**2"),
        (b * a ** (-2), "b/a**2"),
        (a**b, "a**b"),
        (a ** (-b), "a**(-b)"),
        ((a**b) ** c, "(a**b)**c"),
        (a ** (b**c), "a**b**c"),
        (2**a, "2**a"),
        (sympy.sqrt(a), "math.sqrt(a)"),
        (1 / sympy.sqrt(a), "1/math.sqrt(a)"),
        (a ** sympy.Rational(3, 2), "a**(3/2)"),
        (a ** sympy.Float(1.5), "a**1.5"),
        (sympy.exp(-a / b), "math.exp(-a/b)"),
        (sympy.log(a) / sympy.log(10), "math.log(a)/2.302585092994046"),
        (sympy.pi * a, "math.pi*a"),
        (sympy.Float(0.1) * a, "0.1*a"),
        (sympy.Float(-0.1) * a, "-0.1*a"),
        (a + sympy.Float(-2.5e-7), "a - 2.5e-07"),
        (sympy.Integer(2) ** 60 * a, "1.152921504606847e+18*a"),
        (sympy.Max(a, b, c), "math.maximum(math.maximum(a, b), c)"),
        (sympy.Min(a, 0), "math.minimum(0, a)"),
        (sympy.atan2(a, b), "math.atan2(a, b)"),
        (sympy.Abs(a) * sympy.sign(b), "math.abs(a)*math.sign(b)"),
        (sympy.cot(a), "1/math.tan(a)"),
        (sympy.Piecewise((a, a > 0), (b, True)), "math.where(a > 0, a, b)"),
        (sympy.Piecewise((a, a > 0)), "math.where(a > 0, a, math.nan)"),
        (sympy.Piecewise((a, (a > 0) & (b <= 1)), (b, ~sympy.Ne(a, b)), (c, True)), None),
        (Where(a < b, a, b) * 2, "2*math.where(a < b, a, b)"),
        (Guard(a < b, a), "math.guard(a < b, a)"),
        (sympy.exp(Guard(sympy.true, sympy.Integer(0))) + a, "a + math.exp(math.guard(True, 0))"),
    ],
)
def test_texts(expression: sympy.Expr, text: str | None) -> None:
    found = PYTHON.print(expression)
    if text is not None:
        assert found == text
    compile(found, "<text>", "eval")


def test_the_texts_of_docstrings() -> None:
    phi = unknown_function("phi")(a, b)
    text = TextPrinter().print(sympy.Piecewise((phi**2, (a > 0) & (b < 1)), (sympy.Max(a, b), True)))
    assert text == "if((a > 0 and b < 1), phi(a, b)^2, max(a, b))"


@settings(max_examples=300, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_are_written_in_full(value: float) -> None:
    assert float(PYTHON.print(sympy.Float(value, 17))) == value
    assert float(PYTHON.print(sympy.Float(value))) == value


@settings(max_examples=100, deadline=None)
@given(st.integers(-(10**30), 10**30), st.integers(1, 10**30))
def test_rationals_are_rounded_once(numerator: int, denominator: int) -> None:
    text = PYTHON.print(sympy.Rational(numerator, denominator))
    above, _, below = text.partition("/")
    assert float(above) / float(below or 1) == numerator / denominator


def test_numbers_without_symbols_are_evaluated_once() -> None:
    assert float(PYTHON.print(sympy.sqrt(2) + sympy.log(3))) == pytest.approx(math.sqrt(2) + math.log(3), rel=1e-16)
    for number in (sympy.sqrt(-2), sympy.asin(3), sympy.zoo):
        with pytest.raises(Defect, match="not a real number"):
            PYTHON.print(number)


def test_a_node_without_a_rule_is_a_defect() -> None:
    with pytest.raises(Defect, match="no rule prints the node besselj"):
        PYTHON.print(sympy.besselj(1, x))
    with pytest.raises(Defect, match="was not replaced"):
        PYTHON.print(unknown_function("phi")(x))


def test_every_kind_of_node_that_is_printed_occurs_in_random_models() -> None:
    patterns = re.findall(r"^ +case (.+):", inspect.getsource(printer_module), flags=re.M)
    named = {getattr(sympy, name) for pattern in patterns for name in re.findall(r"sympy\.(\w+)\(\)", pattern)}
    made_elsewhere = {sympy.Symbol, sympy.ITE}  # leaves, and sympy's form of comparisons with a Piecewise
    relations = {kind for kind in strategies.RELATIONS if kind.rel_op in RELATIONS}
    assert len(relations) == len(RELATIONS)
    printed = {*UNARY, *RECIPROCAL, *named, *relations} - made_elsewhere
    assert {sympy.Add, sympy.Mul, sympy.Pow, sympy.Piecewise, sympy.Not} <= printed
    assert printed <= strategies.KINDS, printed - strategies.KINDS


# ---------------------------------------------------------------------- names
@given(st.lists(st.text(min_size=1, max_size=6), min_size=1, max_size=8, unique=True))
def test_identifiers_are_safe_and_distinct(wishes: list[str]) -> None:
    names = Names(("math", "state"))
    found = [names.claim(temporary(wish)) for wish in wishes]
    assert len(set(found)) == len(found)
    for name in found:
        assert name.isidentifier() and not keyword.iskeyword(name) and name not in ("math", "state", "cls", "self")


def test_valid_names_are_unchanged() -> None:
    names = Names(("math",))
    assert [names.claim(symbol(name)) for name in ("x", "μ", "lambda", "math", "lambda_", "c[3]")] == [
        "x",
        "μ",
        "lambda_",
        "math_",
        "lambda__",
        "c_3_",
    ]
    assert identifier("ﬁeld") == "field"  # NFKC, as Python does


# ---------------------------------------------------------------------- statements
def program(
    *values: sympy.Expr, intermediates: tuple[Intermediate, ...] = (), networks: tuple[Network, ...] = ()
) -> list[str]:
    """The statements that compute the values as d0, d1, ..., as text."""
    model = Model("m", states=(State("a"), State("b")), intermediates=intermediates, networks=networks)
    names = Names(("math",))
    for item in (a, b, c, x):
        names.claim(item)
    outputs = [Assignment(temporary(f"d{i}"), value, f"d{i}") for i, value in enumerate(values)]
    lines = []
    for statement in Program(model, outputs).statements:
        printer = PythonPrinter(lambda symbol: names[symbol])
        if isinstance(statement, NetworkCall):
            arguments = ", ".join(map(printer.print, statement.arguments))
            results = [
                "_" if symbol is None else names.claim(symbol, wish)
                for symbol, wish in zip(statement.results, statement.wishes, strict=True)
            ]
            lines.append(f"{', '.join(results)} = net{statement.network}({arguments})")
        else:
            text = printer.print(statement.value)
            lines.append(f"{names.claim(statement.symbol, statement.wish)} = {text}")
    return lines


def test_common_subexpressions_are_computed_once() -> None:
    assert program(a * sympy.exp(b), c * sympy.exp(b)) == ["s1 = math.exp(b)", "d0 = a*s1", "d1 = c*s1"]
    assert program(a / (b + c), b / (b + c)) == ["s1 = b + c", "d0 = a/s1", "d1 = b/s1"]
    assert program(2 * a + b, 2 * a - b, -a) == ["d0 = 2*a + b", "d1 = 2*a - b", "d2 = -a"]


def test_intermediates_keep_their_names_and_unused_ones_are_omitted() -> None:
    lets = (
        Intermediate("p", value=a * b),
        Intermediate("unused", value=sympy.exp(a)),
        Intermediate("q", value=symbol("p") + c),
    )
    assert program(symbol("q") ** 2, intermediates=lets) == ["p = a*b", "q = c + p", "d0 = q**2"]


def test_cyclic_intermediates_are_a_defect() -> None:
    lets = (Intermediate("p", value=symbol("q") + 1), Intermediate("q", value=symbol("p") ** 2))
    with pytest.raises(Defect, match="cyclically"):
        program(symbol("q"), symbol("p"), intermediates=lets)


def test_networks_are_called_once_for_each_tuple_of_arguments() -> None:
    network = Network(("f", "g"), (Argument("a"), Argument("b")))
    f, g = unknown_function("f"), unknown_function("g")
    assert program(f(a, b) + g(a, b), f(a, b), networks=(network,)) == ["f, g = net0(a, b)", "d0 = f + g", "d1 = f"]
    assert program(f(b, a) * f(a + 1, b), networks=(network,)) == [
        "f_2, _ = net0(a + 1, b)",
        "f_b_a, _ = net0(b, a)",
        "d0 = f_2*f_b_a",
    ]
    nested = program(f(g(a, b), b), networks=(network,))
    assert nested[0] == "_, g = net0(a, b)"
    with pytest.raises(Defect, match="is not an unknown"):
        program(unknown_function("h")(a))


def test_choices_share_their_condition_and_guard_risky_branches() -> None:
    choice = sympy.Piecewise((sympy.log(a), a > b), (a**2, True))
    assert program(choice) == ["if1 = a > b", "d0 = math.where(if1, math.log(math.guard(if1, a)), a**2)"]
    assert program(sympy.Piecewise((a, a > b), (b, True))) == ["d0 = math.where(a > b, a, b)"]
