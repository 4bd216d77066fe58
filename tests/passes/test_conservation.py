"""Conservation laws and decisions on claims, compared with results derived by hand."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from gbspec.ir.model import Model
from gbspec.passes.claims import check_claims
from gbspec.passes.conservation import Law, linear_laws
from gbspec.passes.examination import examine
from tests.effort import calls
from tests.texts import ROOT, model_at, model_of

ENZYME = (
    "model enzyme\nstate E\nstate S\nstate C\nstate P\nlearn k = 1\nlearn Y = 2\nunknown bind(S, E, C)\n"
    "process binding: E + S -> C rate bind\nprocess release: C -> E + Y*P rate k*C\nobserve S\n"
)

IF_SEX = "model m\nstate x\nstate y\ncondition D\nlearn k = 1\nx' = -k*{}\ny' = k*x\nobserve x\n"


def laws(text: str) -> list[str]:
    return [str(law) for law in linear_laws(model_of(text))]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (ENZYME, ["C + E", "E*Y - P - S*Y"]),
        ("model m\nstate x\nstate y\nunknown f(x)\nx' = -f(x)\ny' = 0.5*f(x)\nobserve x\n", ["x + 2*y"]),
        ("model m\nstate x\nstate y\nunknown f(x)\nx' = -f(x)\ny' = f(y)\nobserve x\n", []),
        (
            "model m\nstate x\nstate y\nlearn a = 1\nx' = -a*(x - 0.1*y)/(1 + x)\n"
            "y' = 2*a*(x - y/10)/(1 + x)\nobserve x\n",
            ["2*x + y"],
        ),
        ("model m\nstate x\nstate y\nx' = 0\ny' = 1\nobserve x\n", ["x"]),
        ("model m\nstate x\nstate y\nlet r = x*y\nx' = -r\ny' = x*y\nobserve x\n", ["x + y"]),
        ("model m\nstate x\nstate y\ncondition D\nx' = D*(1 - x)\ny' = -D*y\nobserve x\n", []),
        ("model m\nstate x\nstate y\nunknown f(u)\nx' = f(2.5)*y\ny' = f(1)*y\nobserve x\n", ["x*f(1) - y*f(5/2)"]),
    ],
)
def test_laws(text: str, expected: list[str]) -> None:
    assert laws(text) == expected


def test_laws_of_published_systems() -> None:
    by_name = {p.stem: p for p in (ROOT / "models").glob("*/*.gb")}
    found = [str(law) for law in linear_laws(model_at(by_name["alpha_pinene"]))]
    assert found[0] == "y1 + y2 + y3 + y4 + y5"
    assert linear_laws(model_at(by_name["bf_gb2"])) == ()


def ring(n: int) -> Model:
    lines = ["model ring", "learn k = 1 in [0, 10]", *(f"state x{i}" for i in range(n))]
    lines += [f"process p{i}: x{i} -> x{(i + 1) % n} rate k*x{i}*x{(i + 3) % n}" for i in range(n)]
    return model_of("\n".join([*lines, "observe x0", ""]))


def test_the_effort_grows_with_the_number_of_states() -> None:
    found: list[Law] = []
    small, large = (calls(lambda m=m: found.extend(linear_laws(m))) for m in (ring(100), ring(400)))
    assert large < 1.5 * 4 * small
    assert [[value for _, value in law.coefficients] for law in found] == [[1] * 100, [1] * 400]


def claimed(text: str) -> list[tuple[str, str | None]]:
    model: Model = model_of(text)
    findings = Findings()
    check_claims(model, findings)
    return [(d.code, d.subject) for d in findings]


REACTOR = (
    "model reactor\nstate X\nstate S\nconst Y = 0.3\nconst inverse = 1/0.3\ncondition D\ninput F held\nunknown mu(S)\n"
    "process growth: 1/Y*S -> X rate mu*X\nX' = net(X) - D*X\nS' = net(S) + D*(10 - S)\nobserve X\n"
)


@pytest.mark.parametrize(
    ("claim", "expected"),
    [
        ("conserve c = S + X/Y rate D*(10 - S - X/Y)", []),
        ("conserve c = S + X*inverse rate D*(10 - S - X*inverse)", []),
        ("conserve c = S + X/Y", [("GB330", "c")]),
        ("conserve c = S - X/Y rate D*(10 - S - X/Y)", [("GB330", "c")]),
        ("conserve c = S + X*3.34 rate D*(10 - S - X*3.34)", [("GB330", "c")]),
        ("conserve c = F*X", [("GB332", "c")]),
        ("conserve c = 2*t rate 2", []),
        ("conserve c = S + X/Y + floor(t)", [("GB330", "c")]),
        ("conserve c = S + X/Y + floor(X) rate D*(10 - S - X/Y)", [("GB331", "c")]),
        ("conserve c = 2*t rate 2 + mod(t, 3) + 3*floor(t/3) - t", []),
        ("let total = Y*S + X\nconserve c = total*exp(D*t) rate 10*Y*D*exp(D*t)", []),
    ],
)
def test_claims(claim: str, expected: list[tuple[str, str | None]]) -> None:
    assert claimed(REACTOR + claim + "\n") == expected


def test_claims_beyond_linear_ones() -> None:
    oscillator = "model m\nstate q\nstate w\nlearn k = 1\nunknown f(q)\nq' = w\nw' = -k*q{}\nobserve q\n"
    energy = "conserve energy = w^2/2 + k*q^2/2\n"
    assert claimed(oscillator.format("").replace("unknown f(q)\n", "") + energy) == []
    assert claimed(oscillator.format(" + f(q)*w") + energy) == [("GB330", "energy")]
    trivial = "conserve one = sin(w)^2 + cos(w)^2\n"
    assert claimed(oscillator.format(" + f(q)") + trivial) == []


def test_what_remains_is_shown() -> None:
    findings = Findings()
    check_claims(model_of(REACTOR + "conserve c = S + X/Y\n"), findings)
    (finding,) = findings
    assert "10*D" in finding.label
    assert [label.span.text for label in finding.labels] == ["X", "S"]


def test_disturbed_states_conserve_nothing() -> None:
    text = (
        "model m\nstate x\nstate y\nstate z\nstate w\nlearn k = 1\nx' = -k*x\ny' = k*x\nz' = -k*z\nw' = k*z\n"
        "diffusion x = 0.1\nobserve x\n"
    )
    examination = examine(model_of(text), Findings())
    assert [str(law) for law in examination.laws] == ["w + z"]
