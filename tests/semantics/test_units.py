"""Units: agreement, disagreement, and inference from use."""

from __future__ import annotations

import subprocess
import sys
from fractions import Fraction

import pytest

from gbspec.diagnostics import Findings
from gbspec.semantics.units import Namespace, Unit, read
from tests.texts import checked, codes

HEAD = """model m
time t : h
unit gX
unit gS
state X : gX/L in [0, 50] = 0.1
state S : gS/L
condition D : 1/h = 0.1
input F : L/h held
const V : L = 2
const Y : gX/gS = 0.5
learn K : gS/L = 0.1
learn top = 0.4 in [0, 1]
function monod(s, k) = s/(k + s)
unknown mu(s : gS/L) : 1/h
allow GB403
allow GB404
"""
TAIL = "X' = {}\nS' = -mu(S)*X/Y + D*(0 - S)\nobserve X\n"


def balance(expression: str, *more: str) -> list[str]:
    return codes(HEAD + "\n".join(more) + "\n" + TAIL.format(expression))


@pytest.mark.parametrize(
    "expression",
    [
        "mu(S)*X",
        "mu(S)*X + 0",
        "top*monod(S, K)*X - D*X - F/V*X",
        "X/(2*V)*F*pi",
        "sqrt(D^2)*X",
        "(D^3)^(1/3)*X",
        "X*D*exp(-S/K)*abs(sin(t*D))",
        "if(S > K and not X < 0, D*X, 0)",
        "min(D, mu(S))*X*sign(S)",
        "D*X*(S/K)^2.5",
        "max(0, D*X)",
        "D*X*atan2(S, K)",
        "D*X*log10(S/K)",
    ],
)
def test_what_agrees(expression: str) -> None:
    assert balance(expression) == []


@pytest.mark.parametrize(
    ("expression", "code"),
    [
        ("mu(S)*S", "GB504"),
        ("mu(X)*X", "GB504"),
        ("D*X + D*S", "GB502"),
        ("D*X + 1", "GB502"),
        ("X", "GB504"),
        ("D*X*exp(S)", "GB503"),
        ("D*X*sin(t)", "GB503"),
        ("if(S > X, D*X, 0)", "GB502"),
        ("if(S > K, D*X, X)", "GB502"),
        ("monod(S, X)*D*X", "GB502"),
        ("D*X*2^S", "GB503"),
        ("D*X*S^(X/X)", "GB503"),
        ("max(D, X)*X", "GB502"),
        ("F*X", "GB504"),
    ],
)
def test_what_does_not(expression: str, code: str) -> None:
    assert balance(expression) == [code]


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("let r : gX/L/h = D*X", []),
        ("let r : gX/L = D*X", ["GB504"]),
        ("let r = D*X + S", ["GB502"]),
        ("const twice : gX/gS = 2*Y", []),
        ("const twice : gS/gX = 2*Y", ["GB504"]),
        ("learn other : gS/L = 1 in [0, 5]", []),
        ("learn other : gS/L = 1 < 100*Y", ["GB504"]),
        ("initial X = 0.1", []),
        ("initial X = Y*S", []),
        ("initial X = 2*S", ["GB504"]),
        ("observe total = X*V : gX", []),
        ("observe total = X*V : mg", ["GB504"]),
        ("observe S : gX/L", ["GB504"]),
        ("conserve c = X + Y*S rate D*(0 - X - Y*S)", []),
        ("conserve c = X + S", ["GB502"]),
        ("dose S times 0.5 lag 2", []),
        ("dose S times Y", ["GB504"]),
        ("dose S lag 1/D", []),
        ("dose S lag D", ["GB504"]),
        ("unknown other(a : gS/L) : 1/h = top*monod(a, K)*nn", []),
        ("unknown other(a : gS/L) : 1/h = K*nn + a", ["GB504"]),
        ("unknown other(a : gX/L) : 1/h = D_0*monod(a, K)*nn\nconst D_0 : 1/h = 1", ["GB502"]),
        ("truth mu(s) = s", []),
        ("const thing : foo/L = 3", ["GB501"]),
        ("const thing : foo/L = 3\nconst other : foo = 2", ["GB501"]),
        ("process p: 1/Y*S -> X rate D*X", ["GB307", "GB307"]),
        ("process p: Y*S -> X rate D*X", ["GB504", "GB307", "GB307"]),
    ],
)
def test_statements(statement: str, expected: list[str]) -> None:
    found = balance("D*X", statement)
    assert sorted(found) == sorted(expected)


def test_a_unit_is_found_from_use() -> None:
    text = (
        "model m\ntime t : h\nstate x : g\nstate y\nlearn k\nlearn c : 1/h = 1\nx' = -k*x\ny' = k*x - c*y\nobserve x\n"
    )
    text = text.replace("learn k", "learn k = 1")
    assert codes(text) == []
    assert codes(text + "observe z = y : mg\n") == ["GB504"]


def test_a_model_without_units_is_not_checked() -> None:
    assert codes("model m\nstate x\nx' = -x + 1\nobserve x\n") == []
    program = 'import sys; from tests.texts import codes; codes("model m\\nstate x\\nx\' = -x\\n"); '
    subprocess.run([sys.executable, "-c", program + "assert 'pint' not in sys.modules"], check=True)


def test_what_is_undetermined_is_reported_once() -> None:
    text = "model m\nstate x : g\nlearn k = 1\nlearn c = 1\nx' = -k*x - c*x\nobserve x\n"
    _, findings = checked(text)
    assert [(d.code, d.subject) for d in findings] == [("GB550", "t")]
    assert codes(text.replace("model m\n", "model m\ntime t : h\n")) == []


@pytest.mark.parametrize("name", ["k", "z"])  # solved before the state, and after it
def test_a_name_is_not_both_undetermined_and_in_mixed_units(name: str) -> None:
    text = "model m\ntime t : s\nstate soc in [0, 1] = 0.5\ninput I : A held\nconst Q : A*h = 2\n"
    _, findings = checked(f"{text}learn {name} = 1 in [0, 2]\nsoc' = -{name}*I/Q\nobserve soc\n")
    assert [(d.code, d.subject) for d in findings] == [("GB550", "soc"), ("GB551", name)]


@pytest.mark.parametrize(
    ("condition", "help"),
    [
        ("t > 69", "`(69 in day)`, or by a name: `const NAME : day = 69`"),
        ("-1.5 < t", "`(-1.5 in day)`, or by a name: `const NAME : day = -1.5`"),
        ("t - 2 > (69 in day)", "`(2 in day)`"),
        ("mod(t, 7) < (2 in day)", "`(7 in day)`"),
        ("1 + t/3 < t", "a factor with the unit `1/day` is missing"),
    ],
)
def test_a_bare_number_beside_a_unit_gets_the_unit(condition: str, help: str) -> None:
    text = "model m\ntime t : day\nstate y : g\nlearn b : 1/day = 1\ny' = if({}, -b*y, 0)\nobserve y\n"
    _, (error, *_) = checked(text.format(condition))
    assert error.code == "GB502" and help in error.help
    if "in day)`" in help:
        number = help.split("`")[1]
        bare = number[1:].split(" ")[0]
        assert codes(text.format(condition.replace(bare, number, 1))) == []


def test_user_units_have_a_separate_namespace() -> None:
    text = "model m\ntime h : s\nunit h\nstate g : h\nconst s : h/s = 1\ng' = -s\nobserve g\n"
    assert codes(text) == []


def unit(**names: int) -> Unit:
    return Unit(tuple(sorted((name, Fraction(exponent)) for name, exponent in names.items())))


@pytest.mark.parametrize(
    ("first", "second", "equal"),
    [
        (unit(L=1), unit(dm=3), True),
        (unit(L=1), unit(mL=1), False),
        (unit(N=1), unit(kg=1, m=1, s=-2), True),
        (unit(degC=1), unit(K=1), False),
        (unit(degC=1), unit(celsius=1), True),
        (unit(hour=1), unit(h=1), True),
        (unit(rad=1), unit(), True),
        (unit(deg=1), unit(), False),
        (unit(percent=1), unit(), False),
        (unit(X=1), unit(X=2), False),
    ],
)
def test_equality(first: Unit, second: Unit, equal: bool) -> None:
    namespace = Namespace(frozenset({"X"}))
    assert namespace.is_one(first.times(second, Fraction(-1))) is equal


def test_factor_in_the_help() -> None:
    _, findings = checked(
        "model m\ntime t : h\nstate m : g\nconst q : mg/h = 1\nlearn k : 1/h = 1\nm' = q - k*m\nobserve m\n"
    )
    (finding,) = findings
    assert finding.help == "convert it: `(k*m in mg/h)`, a factor of 1000"


@pytest.mark.parametrize(
    ("per", "rate", "word"),
    [("J/min/W = 60", "P/per/C", "multiply by"), ("W*min/J = 1/60", "P*per/C", "divide by")],
)
def test_a_conversion_the_wrong_way_round_is_not_answered_with_another(per: str, rate: str, word: str) -> None:
    text = f"model m\ntime t : min\ncondition P : W\nconst per : {per}\nconst C : J/K = 10\nstate T : K = 300\n"
    _, findings = checked(f"{text}T' = {rate}\nobserve T\n")
    (found,) = findings
    assert found.code == "GB504" and found.help.endswith(f"is the wrong way round: {word} it")


def test_numbers_in_units() -> None:
    from gbspec.diagnostics import Source
    from gbspec.syntax import ast
    from gbspec.syntax.parser import parse

    findings = Findings()
    file = parse(Source("u.gb", "model m\nstate x : 10^3*L/(h*mol)^2\n"), findings)
    assert file is not None
    statement = file.statements[1]
    assert isinstance(statement, ast.StateStatement)
    assert statement.unit is not None
    namespace = Namespace(frozenset())
    found = read(statement.unit, namespace, findings)
    assert found is not None
    assert namespace.measure(found).factor == pytest.approx(1e3 * 1e-3 / 3600**2)
