"""Warnings of values that do not exist somewhere, and of the many expressions that do."""

from __future__ import annotations

import pytest

from gbspec.data import shipped_models
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model

CODES = {"GB316", "GB317", "GB318", "GB319"}


def doubts(text: str) -> list[str]:
    findings = Findings()
    load_model("m.gb", findings, lambda path: Source(str(path), f"model m\n{text}\n"))
    return [one.code for one in findings if one.code in CODES]


def rate(expression: str, state: str = "state x in [0, 10] = 5", more: str = "") -> list[str]:
    return doubts(f"{state}\n{more}\nx' = {expression}\nobserve x")


@pytest.mark.parametrize("name", sorted(shipped_models()))
def test_no_bundled_model_is_doubted(name: str) -> None:
    findings = Findings()
    load_model(name, findings)
    assert [one.code for one in findings if one.code in CODES] == []


@pytest.mark.parametrize(
    ("expression", "codes"),
    [
        ("log(x - 1)", ["GB316"]),
        ("sqrt(5 - x)", ["GB316"]),
        ("log10(x*(x - 9.5))", ["GB316"]),
        ("log(x)", []),
        ("log(x + 1e-3)", []),
        ("sqrt(x^2 - 2*x + 1)", []),  # never negative, though intervals alone cannot tell
        ("log(max(x - 1, 0.1))", []),
        ("if(x > 1, log(x - 1), 0)", []),
        ("(x - 2)^1.5", ["GB318"]),
        ("(x - 2)^2", []),
        ("(x - 2)^(1 + 1)", []),
        ("x^1.5", []),
        ("x^x", []),
        ("abs(x - 2)^1.5", []),
        ("1/(x - 5)", ["GB317"]),
        ("(x - 5)/(x - 5)", ["GB317"]),
        ("if(x > 5, 1/(x - 5), 0)", []),
        ("1/(x - 4)", []),
    ],
)
def test_expressions(expression: str, codes: list[str]) -> None:
    assert rate(expression) == codes


def test_a_logarithm_of_a_name_without_a_range_is_not_judged() -> None:
    assert rate("log(x - 1)", "state x = 5") == []
    assert rate("log(u - 1)*x", more="input u held") == []
    assert rate("log(u - 1)*x", more="input u in [0, 3] held") == ["GB316"]


def test_named_expressions_are_followed() -> None:
    assert rate("log(b)", more="let a = x - 1\nlet b = 2*a") == ["GB316"]
    assert rate("log(b)", more="let a = x + 1\nlet b = 2*a") == []


def test_learned_exponents_and_constants_count_with_their_ranges() -> None:
    assert rate("(x - c)^2", more="learn c = 2 in [0, 4]") == []
    assert rate("(x + c)^n", more="learn c = 2 in [0, 4]\nlearn n = 2 in [1, 3]") == []
    assert rate("(x - c)^n", more="learn c = 2 in [0, 4]\nlearn n = 2 in [1, 3]") == ["GB318"]


def test_a_start_that_is_measured_or_learned_is_not_known() -> None:
    assert rate("1/x", "state x") == []
    assert rate("1/x", "state x = 0\ninitial x learn") == []
    assert rate("1/x", "state x = 0") == ["GB317"]
    assert rate("1/x", "state x\ninitial x = 0") == ["GB317"]


def test_the_elements_of_an_array_are_one_warning() -> None:
    assert doubts("state c[1..5] in [0, 2] = 1\nc[i]' = -log(1 - c[i])\nobserve c[1]") == ["GB316"]


@pytest.mark.parametrize(
    ("process", "codes"),
    [
        ("x -> y", []),
        ("2*x -> Y*y", []),
        ("x -> Z*y", ["GB319"]),
        ("x -> -Y*y", ["GB319"]),
        ("x -> y/Y", []),
        ("x -> (1 - Y)*y", []),
        ("x -> (1 - 2*Y)*y", ["GB319"]),
    ],
)
def test_coefficients(process: str, codes: list[str]) -> None:
    learned = "learn Y = 0.5 in [0, 1]\nlearn Z = 0.5 in [-1, 1]\nallow GB403"
    text = f"state x = 1\nstate y = 0\n{learned}\nprocess p: {process} rate x\nobserve x\nobserve y"
    assert doubts(text) == codes


def test_a_warning_is_accepted_by_its_name() -> None:
    assert rate("log(x - 1)", more="allow GB316 x") == []
