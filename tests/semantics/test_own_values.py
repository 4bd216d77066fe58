"""Constants with a value for each category of a condition."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from sympy import Expr

from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir import Model
from gbspec.lower import lower
from gbspec.semantics import check
from gbspec.syntax.parser import parse

OWN = """model strains
time t : h
state X : g/L in [0, 5]
condition strain in {"wild type", mutant, other} = mutant
learn k : 1/h = 1 in [0.1, 5] per strain "rate"
X' = -k*X
initial X = k*(2 in g*h/L)
observe X
truth k_mutant = 2
"""


def read(text: str) -> tuple[Model | None, Findings]:
    findings = Findings()
    file = parse(Source("strains.gb", text), findings)
    assert file is not None
    checked = check(file, findings, lambda path: Source(str(path), ""))
    return (None if checked is None else lower(checked, findings)), findings


def value(model: Model, expression: Expr, at: Mapping[str, float]) -> float:
    """An expression at numbers; names of `let` stand for their expressions."""
    lets = {one.name: one.value for one in model.intermediates}
    whole = expression.subs({s: lets[s.name] for s in expression.free_symbols if s.name in lets})
    return float(whole.subs({s: at.get(s.name, 0.0) for s in whole.free_symbols}))


def test_each_category_has_a_constant_that_the_condition_chooses() -> None:
    model, findings = read(OWN)
    assert model is not None and not list(findings)
    assert [(k.name, k.start, k.unit, k.description) for k in model.learnables] == [
        (name, 1.0, "1/h", "rate") for name in ("k_wild_type", "k_mutant", "k_other")
    ]
    values = {"X": 3.0, "k_wild_type": 5.0, "k_mutant": 7.0, "k_other": 11.0}
    start = model.states[0].initial.value
    assert start is not None
    for number, k in enumerate((5.0, 7.0, 11.0)):
        at = {**values, "strain": float(number)}
        assert value(model, model.balances[0], at) == -3.0 * k
        assert value(model, start, at) == 2.0 * k
    assert [(one.name, one.value) for one in model.truth_constants] == [("k_mutant", 2.0)]


@pytest.mark.parametrize(
    ("slip", "code"),
    [
        (OWN.replace("strain in", "sort in"), "GB421"),  # no condition of that name
        (OWN.replace("per strain", "per strain per trajectory"), "GB421"),
        (OWN.replace("truth k_mutant", "truth k_mutnat"), "GB219"),
        (OWN.replace("state X", "const k_other : 1/h = 1\nstate X"), "GB382"),
        (OWN.replace("mutant, other", "wild_type, mutant, other"), "GB382"),
        (OWN.replace("learn k", "learn k[1..2]"), "GB421"),
    ],
    ids=["no categories", "another grouping", "a misspelt name", "a name in use", "two names in one", "a row"],
)
def test_slips_are_reported(slip: str, code: str) -> None:
    _, findings = read(slip)
    assert code in {finding.code for finding in findings}
    assert "GB202" not in {finding.code for finding in findings}


def test_arguments_of_functions_shadow() -> None:
    """A function's own `k` and `strain` are not those of the model."""
    model, findings = read(OWN.replace("X' = -k*X", "function f(k, strain) = k*(strain + 1)\nX' = -k*f(X, 1)"))
    assert model is not None and not list(findings)
    assert value(model, model.balances[0], {"X": 3.0, "k_mutant": 7.0, "strain": 1.0}) == -7.0 * 3.0 * 2.0


def test_an_unknown_is_applied_to_such_a_constant_by_its_name() -> None:
    model, _ = read(OWN.replace("X' = -k*X", "unknown f(X, k) : g/L/h\nX' = -f"))
    assert model is not None and [a.name for a in model.networks[0].arguments] == ["X", "k"]


def test_a_truth_and_an_accepted_warning_hold_for_each() -> None:
    unused = OWN.replace("truth k_mutant", "truth k").replace("-k*X", "-X").replace("k*(2 in g*h/L)", "2")
    model, findings = read(unused.replace("X' = -X", "X' = -X*(1 in 1/h)") + "allow GB403 k\n")
    assert model is not None and not list(findings)
    assert [(one.name, one.value) for one in model.truth_constants] == [
        ("k_wild_type", 2.0),
        ("k_mutant", 2.0),
        ("k_other", 2.0),
    ]


def test_the_model_of_a_run_has_each_statement_once(tmp_path: Path) -> None:
    """A file that extends another is kept as merged statements, which are read again."""
    (tmp_path / "base.gb").write_text(OWN.replace("model strains", "model base").replace("truth k_mutant = 2\n", ""))
    (tmp_path / "more.gb").write_text('model more extends "base.gb"\ntruth k = 3\n')
    text = load_model(tmp_path / "more.gb", Findings()).text
    assert text.count("per strain") == text.count("truth k ") == 1
    model, findings = read(text)
    assert model is not None and not list(findings)


def test_a_condition_that_cannot_be_read_has_no_missing_categories() -> None:
    _, findings = read(OWN.replace("mutant, other", "mutant, if"))
    assert "GB421" not in {finding.code for finding in findings}
