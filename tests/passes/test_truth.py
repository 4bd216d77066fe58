"""Substitution of the truth for learnables and unknowns."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import UserError
from gbspec.ir.model import symbol
from gbspec.ir.verification import verify
from gbspec.passes import with_truth, with_values
from tests.texts import SHIPPED, model_at, model_of

x, y, k = symbol("x"), symbol("y"), symbol("k")


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_bundled_models_with_a_truth_become_complete(path: Path) -> None:
    model = model_at(path)
    if not model.has_truth:
        with pytest.raises(UserError):
            with_truth(model)
        return
    complete = with_truth(model)
    verify(complete)
    assert complete.complete
    assert not complete.learnables
    assert complete.constant_names == model.constant_names


def test_bodies_replace_nested_applications() -> None:
    model = model_of(
        "model m\nstate x\nstate y\nlearn k = 1\nunknown f(a, b)\nunknown g(a)\nlet r = f(x, g(y))\n"
        "x' = r + f(f(x, y), x)\ny' = k*g(f(y, x))\nobserve z = g(g(x))\n"
        "truth k = 4\ntruth f(y, x) = y - 2*x\ntruth g(u) = k*u^2\n"
    )
    complete = with_truth(model)
    assert complete.intermediates[0].value == x - 2 * k * y**2
    assert complete.balances[0] == symbol("r") + (x - 2 * y) - 2 * x
    assert complete.balances[1] == k * k * (y - 2 * x) ** 2
    assert complete.channels[0].value == k * (k * x**2) ** 2
    assert [(c.name, c.value) for c in complete.constants] == [("k", 4.0)]


def test_learnables_without_a_truth_have_their_starting_value() -> None:
    complete = with_truth(model_of("model m\nstate x\nlearn k in [0, 10]\nx' = -k*x\nobserve x\n"))
    assert [(c.name, c.value) for c in complete.constants] == [("k", 5.0)]


def test_every_unknown_without_a_truth_is_named() -> None:
    model = model_of("model m\nstate x\nunknown f, g(x)\nunknown h(x)\nx' = f + g + h\nobserve x\ntruth g(x) = x\n")
    with pytest.raises(UserError) as caught:
        with_truth(model)
    assert [(d.code, d.subject) for d in caught.value.diagnostics] == [("GB803", "f"), ("GB803", "h")]


def test_truth_of_truths() -> None:
    model = model_of("model m\nstate x\nlearn a = 1\nlearn b = 1\nx' = -a*b*x\nobserve x\ntruth a = 2*b\ntruth b = 3\n")
    assert [(c.name, c.value) for c in with_truth(model).constants] == [("a", 6.0), ("b", 3.0)]


def test_values_are_set() -> None:
    model = model_of(
        "model m\nstate x\nconst c = 1\nlearn k = 1 in [0, 2]\ncondition Da = 0.3\ninput F held\n"
        "x' = -k*x*c*Da + F\nobserve x\ntruth k = 1.5\n"
    )
    changed = with_values(model, {"c": 2, "k": 5, "Da": 0.4, "F": 1})
    verify(changed)
    assert changed.constants[0].value == 2
    assert (changed.learnables[0].start, changed.learnables[0].range.high) == (5, 5)
    assert changed.truth_constants[0].value == 5
    assert changed.conditions[0].default == 0.4
    assert changed.inputs[0].default == 1
    assert model.constants[0].value == 1


def test_wrong_settings_are_all_reported() -> None:
    model = model_of("model m\nstate x\nlearn beta = 1\nx' = -beta*x\nobserve x\n")
    with pytest.raises(UserError) as caught:
        with_values(model, {"bta": 2, "x": 1, "beta": float("nan")})
    assert [d.code for d in caught.value.diagnostics] == ["GB804"] * 3
    assert caught.value.diagnostics[0].help == "did you mean `beta`?"
