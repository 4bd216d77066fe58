"""One mistake gives one diagnostic, and none hides another."""

from __future__ import annotations

import pytest

from tests.texts import checked, codes

RIGHT = """model m
state x in [0, 1]
state y
condition Da in [0.2, 0.5]
input F held
const a = 2
learn k = 1 in [0, 10]
let r = k*x
function f(s) = s/(1 + s)
unknown phi(x, y)
process p: a*x -> y rate r
x' = net(x) - phi*Da + F
y' = net(y) - f(y)
initial x = a*Da
observe x
observe z = x + y
truth k = 3
truth phi(x, y) = k*x*y
"""


def test_the_right_text_is_right() -> None:
    assert codes(RIGHT) == []


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("const a = 2", "const a = 1/0", "GB223"),
        ("const a = 2", "const a = k", "GB224"),
        ("const a = 2", "const a = b", "GB201"),
        ("const a = 2", "const a = a", "GB208"),
        ("const a = 2\n", "", "GB201"),
        ("let r = k*x", "let r = k*x*r", "GB208"),
        ("let r = k*x", "let r = k*x(t)", "GB204"),
        ("let r = k*x\n", "", "GB201"),
        ("state y\n", "", "GB201"),
        ("function f(s) = s/(1 + s)", "function f(s) = s/(1 + q)", "GB201"),
        ("function f(s) = s/(1 + s)\n", "", "GB201"),
        ("unknown phi(x, y)", "unknown phi(x, w)", "GB206"),
        ("unknown phi(x, y)", "unknown phi(x)", "GB220"),
        ("learn k = 1 in [0, 10]", "learn k = 1 in [10, 0]", "GB225"),
        ("learn k = 1 in [0, 10]", "learn k in [0, q]", "GB201"),
        ("process p: a*x -> y rate r", "process p: a*x*y -> y rate r", "GB305"),
        ("process p: a*x -> y rate r", "process p: a*x -> y rate q", "GB201"),
        ("observe z = x + y", "observe y = x + y", "GB202"),
        ("observe z = x + y", "observe z = x + w", "GB201"),
        ("input F held", "input F", "GB227"),
        ("truth k = 3", "truth k = 1/0", "GB223"),
        ("y' = net(y) - f(y)", "y' = net(y) - f(y, y)", "GB207"),
        ("y' = net(y) - f(y)", "y' = net(y) - f", "GB205"),
        ("state x in [0, 1]", "state x in [0, 1] = 2", "GB222"),
    ],
)
def test_one_mistake_gives_one_diagnostic(old: str, new: str, code: str) -> None:
    assert old in RIGHT
    found = [c for c in codes(RIGHT.replace(old, new, 1)) if not (c == "GB201" and code == "GB201")]
    expected = [] if code == "GB201" else [code]
    assert found == expected
    assert code in codes(RIGHT.replace(old, new, 1))


def test_a_name_that_is_missing_everywhere_is_reported_once() -> None:
    text = RIGHT.replace("const a = 2\n", "")
    assert codes(text) == ["GB201"]


def test_a_statement_that_cannot_be_read_does_not_make_others_wrong() -> None:
    found = codes(RIGHT.replace("const a = 2", "const a = = 2").replace("state y\n", "state y in [0 1]\n"))
    assert all(code.startswith("GB1") for code in found)
    assert len(found) == 2


def test_several_mistakes_are_all_reported() -> None:
    text = RIGHT.replace("const a = 2", "const a = 1/0").replace("input F held", "input F").replace("- f(y)", "- f(q)")
    assert codes(text) == ["GB227", "GB223", "GB201"]


def test_an_observed_definition_is_used() -> None:
    assert codes("model m\nstate x = 1\nx' = -x\nlet y = 2*x\nobserve y\n") == []


def test_unused_names_are_reported_only_of_a_text_without_errors() -> None:
    assert codes(RIGHT.replace("- f(y)", "")) == ["GB403"]
    assert codes(RIGHT.replace("- f(y)", "- g(y)")) == ["GB201"]


def test_allow_accepts_a_warning_by_name() -> None:
    text = RIGHT.replace("- f(y)", "")
    assert codes(text + "allow GB403 f\n") == []
    assert codes(text + "allow GB403\n") == []
    assert codes(text + "allow GB403 k\n") == ["GB403"]


def test_a_learnable_behind_a_let_in_a_condition_has_no_gradient() -> None:
    text = "model m\nstate x\nlearn k = 1\nlet limit = 2*k\nx' = if(x > limit, -x, 1)\nobserve x\n"
    assert codes(text) == ["GB404"]
    assert codes(text.replace("1)\nobserve", "limit)\nobserve")) == []


def test_what_training_makes_of_a_learned_time_depends_on_the_fit() -> None:
    text = "model m\ntime t\nstate x\nlearn lag = 1\nlearn k = 1{}\nx' = -k*if(t > lag, x, 0)\nobserve x\n"
    for more, said in (
        ("", "steps end there"),
        (" > 0 per trajectory ~ lognormal", "steps end there"),
        ("\ndiffusion x = k", "it stays at its start"),
    ):
        (found,) = [d for d in checked(text.format(more))[1] if d.code == "GB404"]
        assert said in found.help
