"""Constants with a value for each category of a condition."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings, Source
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


def test_each_category_has_a_constant_that_the_condition_chooses() -> None:
    model, findings = read(OWN)
    assert model is not None and not list(findings)
    assert [(k.name, k.start, k.unit, k.description) for k in model.learnables] == [
        (name, 1.0, "1/h", "rate") for name in ("k_wild_type", "k_mutant", "k_other")
    ]
    values = {"X": 3.0, "k_wild_type": 5.0, "k_mutant": 7.0, "k_other": 11.0}
    balance, start = model.balances[0], model.states[0].initial.value
    assert start is not None
    for number, k in enumerate((5.0, 7.0, 11.0)):
        at = {s: values.get(s.name, number) for s in balance.free_symbols | start.free_symbols}
        assert float(balance.subs(at)) == -3.0 * k
        assert float(start.subs(at)) == 2.0 * k
    assert [(one.name, one.value) for one in model.truth_constants] == [("k_mutant", 2.0)]


@pytest.mark.parametrize(
    ("slip", "code"),
    [
        (OWN.replace("strain in", "sort in"), "GB421"),  # no condition of that name
        (OWN.replace("per strain", "per strain per trajectory"), "GB421"),
        (OWN.replace("truth k_mutant", "truth k_mutnat"), "GB219"),
        (OWN.replace("state X", "const k_other : 1/h = 1\nstate X"), "GB202"),
    ],
    ids=["no categories", "another grouping", "a misspelt name", "a name in use"],
)
def test_slips_are_reported(slip: str, code: str) -> None:
    _, findings = read(slip)
    assert code in {finding.code for finding in findings}
