"""The verifier finds errors in a Model; the dump is complete."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import get_args

import pytest
import sympy

from gbspec.diagnostics import Defect, Findings
from gbspec.ir.dumping import dump
from gbspec.ir.forms import center, input_scale, raw, scale
from gbspec.ir.model import Activation, Channel, Constant, Learnable, Model, Range, symbol, unknown_function
from gbspec.ir.verification import verify
from gbspec.passes.contracts import with_contracts
from gbspec.semantics.vocabulary import ACTIVATIONS
from tests.texts import model_of

TEXT = (
    'model m "Title"\ntime t : h\nstate x : g in [0, 1]\nstate y\ncondition Da = 0.1\ninput F linear\nconst a = 0.1\n'
    "learn k = 1 in [0, 10]\nunknown f, g(x, u) = nn*u by mlp(4)\nlet r = k*x/3\nprocess p: a*x -> y rate f(x, r)\n"
    "y' = net(y) + F*Da*g(x, 2.5)\ninitial x = 2\nobserve x noise normal(0.1)\nobserve z = x + y\n"
    "truth k = 2\ntruth f(x, u) = x*u\ntruth g(x, u) = 0.1*x\n"
)
MODEL = model_of(TEXT)
x, k = symbol("x"), symbol("k")

BREAKAGES: dict[str, Callable[[Model], Model]] = {
    "a balance too few": lambda m: dataclasses.replace(m, balances=m.balances[:1]),
    "an unknown name in a balance": lambda m: dataclasses.replace(m, balances=(symbol("q"), m.balances[1])),
    "an application of nothing": lambda m: dataclasses.replace(m, balances=(unknown_function("h")(x), x)),
    "an application with one argument": lambda m: dataclasses.replace(m, balances=(unknown_function("f")(x), x)),
    "infinity": lambda m: dataclasses.replace(m, balances=(sympy.zoo, x)),
    "intermediates in the wrong order": lambda m: dataclasses.replace(m, intermediates=m.intermediates[::-1]),
    "no rate for a process": lambda m: dataclasses.replace(m, intermediates=m.intermediates[:1]),
    "two things of one name": lambda m: dataclasses.replace(m, constants=(*m.constants, Constant("x"))),
    "two channels of one name": lambda m: dataclasses.replace(m, channels=(*m.channels, m.channels[0])),
    "a channel that is no state": lambda m: dataclasses.replace(m, channels=(Channel("c", value=k, state=0),)),
    "a start outside": lambda m: dataclasses.replace(m, learnables=(Learnable("k", 5.0, Range(0, 1)),)),
    "a constant that is no number": lambda m: dataclasses.replace(m, constants=(Constant("a", float("nan")),)),
    "a network without its outputs": lambda m: dataclasses.replace(m, unknowns=m.unknowns[:1]),
    "a truth with an unknown name": lambda m: dataclasses.replace(
        m, truth_functions=(dataclasses.replace(m.truth_functions[0], value=symbol("y")),)
    ),
    "a range the wrong way": lambda m: dataclasses.replace(
        m, states=(dataclasses.replace(m.states[0], range=Range(1, 0)), m.states[1])
    ),
}


FORMED = with_contracts(model_of(TEXT.replace("= nn*u by mlp(4)", "f >= 0, g increasing in x by mlp(8)")), Findings())


def reformed(**changes: object) -> Model:
    """The model with another form of its first unknown that has one."""
    unknowns = list(FORMED.unknowns)
    form = unknowns[0].form
    assert form is not None
    unknowns[0] = dataclasses.replace(unknowns[0], form=dataclasses.replace(form, **changes))  # type: ignore[arg-type]  # by name
    return dataclasses.replace(FORMED, unknowns=tuple(unknowns))


def relaid(**changes: object) -> Model:
    """The model with another layout of its network."""
    layout = FORMED.networks[0].layout
    assert layout is not None
    changed = dataclasses.replace(layout, **changes)  # type: ignore[arg-type]  # by name
    return dataclasses.replace(FORMED, networks=(dataclasses.replace(FORMED.networks[0], layout=changed),))


def test_a_form_that_a_pass_made_is_verified() -> None:
    verify(FORMED)
    for wrong in (raw(7, 0), raw(0, 5), scale(9), center(9), input_scale(2), symbol("Da"), sympy.Symbol("raw 0")):
        with pytest.raises(Defect, match="the form of `f` uses"):
            verify(reformed(value=wrong))
    with pytest.raises(Defect, match="the evaluations of the form of `f`"):
        verify(reformed(evaluations=((x,),)))
    with pytest.raises(Defect, match="the layout of the network"):
        verify(relaid(hidden=()))
    with pytest.raises(Defect, match="the outputs of the layout"):
        verify(relaid(outputs=()))


def test_a_form_without_a_layout_has_the_outputs_of_its_network_alone() -> None:
    made = with_contracts(model_of(TEXT.replace("= nn*u by mlp(4)", "f >= 0 by mlp(8)")), Findings())
    form = made.unknowns[0].form
    assert form is not None and made.networks[0].layout is None
    for output, right in ((1, True), (2, False)):
        changed = dataclasses.replace(made.unknowns[0], form=dataclasses.replace(form, value=raw(0, output)))
        wrong = dataclasses.replace(made, unknowns=(changed, *made.unknowns[1:]))
        if right:
            verify(wrong)
        else:
            with pytest.raises(Defect, match="the form of `f` uses"):
                verify(wrong)


def test_a_lowered_model_is_right() -> None:
    before = dump(MODEL)
    verify(MODEL)
    assert dump(MODEL) == before


@pytest.mark.parametrize("name", BREAKAGES)
def test_what_is_wrong_is_a_defect(name: str) -> None:
    with pytest.raises(Defect):
        verify(BREAKAGES[name](MODEL))


def test_dump_is_stable_and_complete() -> None:
    assert (
        dump(MODEL)
        == """model m "Title"
time t : h
states
  x : g in [0.0, 1.0] initial 2
  y initial measured
conditions
  Da = 0.1
inputs
  F linear
constants
  a = 0.1
learnables
  k = 1.0 in [0.0, 10.0]
networks
  f, g(x, u) by mlp 2-4-2 silu
unknowns
  f = nn*u  (nn begins at 1.0)
  g = nn*u  (nn begins at 1.0)
intermediates
  let r = k*x/3
  rate p = f(x, r)
processes
  p: x -a, y 1
balances
  x' = -a*p
  y' = Da*F*g(x, 2.5) + p
channels
  x = x  (state 0) noise normal(0.1)
  z = x + y
truths
  k = 2.0
  f(x, u) = u*x
  g(x, u) = 0.1*x
"""
    )


def test_floats_in_a_dump_are_whole() -> None:
    model = model_of("model m\nstate x\nx' = -0.12345678901234567*x\nobserve x\n")
    assert repr(0.12345678901234567) in dump(model)


def test_semantics_knows_the_same_activations() -> None:
    assert set(get_args(Activation)) == set(ACTIVATIONS)


def test_a_dump_has_the_disturbances() -> None:
    text = "model m\nstate x = 1\nlearn s = 0.1 > 0\ndiffusion x = {}\nx' = -x\nobserve x\n"
    assert "x by s\n" in dump(model_of(text.format("s")))
    assert "x by s*x  (logarithm by s)" in dump(model_of(text.format("s*x")))
