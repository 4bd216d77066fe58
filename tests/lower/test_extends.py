"""Files that extend others."""

from __future__ import annotations

from gbspec.ir.dumping import dump
from tests.texts import checked, codes, model_of

BASE = """model base "Base"
state x1
state x2
const B = 11
learn k = 1 in [0, 5]
unknown r1, r2, r3(x1, x2) : g, g, m
    = x1*nn, x2*nn, nn by mlp(8)
x1' = -k*x1 + r1 + r2
x2' = B*r3 - x2
observe x1
observe x2
observe y = x1 + x2
truth k = 3
"""


def test_replacement_keeps_places() -> None:
    model = model_of(
        'model child extends "base.gb"\nlearn B = 5 in [0, 50]\nstate x1 in [0, 1]\nx2\' = B*r3\nobserve y = x1\n'
        "initial x1 = 2\ntruth B = 11\n",
        {"base.gb": BASE},
    )
    assert model.name == "child"
    assert [s.name for s in model.states] == ["x1", "x2"]
    assert model.states[0].range is not None
    assert model.states[0].initial.kind == "expression"
    assert [k.name for k in model.learnables] == ["B", "k"]
    assert str(model.balances[1]) == "B*r3(x1, x2)"
    assert [c.name for c in model.channels] == ["x1", "x2", "y"]
    assert model.channels[2].state == 0
    assert [t.name for t in model.truth_constants] == ["k", "B"]


def test_one_of_several_outputs_can_become_known() -> None:
    child = 'model child extends "base.gb"\nlet r2 = 2*x2\n'
    model = model_of(child, {"base.gb": BASE})
    assert model.networks[0].outputs == ("r1", "r3")
    assert [u.unit for u in model.unknowns] == ["g", "m"]
    assert [str(u.postulate) for u in model.unknowns] == ["nn*x1", "nn"]
    assert dump(model_of(model.text)) == dump(model)


def test_without_removes() -> None:
    model = model_of(
        'model child extends "base.gb"\nwithout observe x2\nwithout y\nwithout truth k\nwithout r1\n'
        "x1' = -k*x1 + r2\n",
        {"base.gb": BASE},
    )
    assert [c.name for c in model.channels] == ["x1"]
    assert not model.truth_constants
    assert model.networks[0].outputs == ("r2", "r3")


def test_without_a_state_removes_statements_about_it() -> None:
    model = model_of(
        'model child extends "base.gb"\nwithout x2\nwithout r3\nwithout y\nwithout B\n'
        "x1' = -k*x1 + r1(x1, 2*x1) + r2(x1, 3*x1)\n",
        {"base.gb": BASE},
    )
    assert [s.name for s in model.states] == ["x1"]
    assert [c.name for c in model.channels] == ["x1"]


def test_chain_of_three() -> None:
    files = {"base.gb": BASE, "middle.gb": 'model middle extends "base.gb"\nconst B = 12\nwithout observe x1\n'}
    model = model_of('model child extends "middle.gb"\nobserve x1 as "first"\n', files)
    assert model.constants[0].value == 12
    assert [c.name for c in model.channels] == ["x2", "y", "x1"]


def test_diagnostics_of_the_base_are_reported_at_their_place() -> None:
    _, findings = checked('model child extends "base.gb"\n', {"base.gb": BASE + "let z = q\n"})
    (finding, *_) = findings.errors
    assert finding.code == "GB201"
    assert finding.place is not None
    assert finding.place.source.path.endswith("base.gb")  # type: ignore[union-attr] # a span, as its code says


def test_a_base_that_is_missing_does_not_hide_other_errors() -> None:
    text = 'model child extends "no.gb"\nlearn k = 20 in [0, 10]\nx1\' = -k*x1\n'
    assert codes(text) == ["GB209", "GB222"]


def test_cycle_of_files() -> None:
    files = {"a.gb": 'model a extends "b.gb"\n', "b.gb": 'model b extends "a.gb"\nstate x\nx\' = -x\nobserve x\n'}
    assert codes('model child extends "a.gb"\n', files) == ["GB211"]


def test_base_must_stay_in_the_folder() -> None:
    for path in ("../base.gb", "/etc/base.gb", "sub/../../base.gb", ""):
        assert codes(f'model child extends "{path}"\nstate x\nx\' = -x\nobserve x\n', {"base.gb": BASE}) == ["GB210"]
