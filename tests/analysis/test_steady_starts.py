"""Steady starts in the evaluator and in the generated module: which is taken, and what is said without one."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from gbspec.backends import Evaluator, load_module
from gbspec.data.trajectories import Signal
from gbspec.diagnostics import ComputationError, Findings, Source
from gbspec.frontend import load_model

HEAD = "model m\nobserve x\n"


def evaluator_of(text: str) -> Evaluator:
    model = load_model("m.gb", Findings(), lambda path: Source(str(path), HEAD + text))
    return Evaluator(load_module(model)())


@pytest.mark.parametrize(("start", "reached"), [(0.2, 0.0), (0.31, 1.0), (3.0, 1.0), (-5.0, 0.0), (0.3, 0.3)])
def test_of_several_the_one_that_the_solution_reaches(start: float, reached: float) -> None:
    one = evaluator_of(f"state x = {start}\nx' = -x*(x - 0.3)*(x - 1)\ninitial steady\n")
    assert one.initial([np.nan])[0] == pytest.approx(reached, abs=1e-12)
    assert float(one.instance.initial([0.0])) == pytest.approx(reached, abs=1e-12)


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e12])
def test_whatever_the_units(size: float) -> None:
    one = evaluator_of(f"state x = {size}\nlearn k = 2\nx' = {size}*k - 3*x\ninitial steady\n")
    assert one.initial([0.0])[0] == pytest.approx(2 * size / 3, rel=1e-12)


def test_stiff_and_conserved() -> None:
    text = """state x = 1
state y = 0
state z = 0
condition total
initial x = total
x' = -0.04*x + 1e4*y*z
y' = 0.04*x - 1e4*y*z - 3e7*y^2 + 0.1*z
z' = 3e7*y^2 - 0.1*z
initial steady
"""
    one = evaluator_of(text)
    state = one.initial(np.zeros(3), [2.0])
    assert state.sum() == pytest.approx(2.0, rel=1e-13)
    assert np.abs(one.rhs_many(0.0, state[None], [2.0])).max() < 1e-12
    found = one.instance.initial(torch.zeros(4, 3).double(), [[2.0], [1.0], [0.5], [2.0]])
    np.testing.assert_allclose(found[0].numpy(), state, rtol=1e-11)
    np.testing.assert_allclose(found.sum(-1).numpy(), [2.0, 1.0, 0.5, 2.0], rtol=1e-13)


def test_in_single_precision() -> None:
    one = evaluator_of("state x = 0.1\nstate y = 1\nx' = y - x^2\ny' = 2 - y\ninitial steady\n")
    found = one.instance.initial(torch.zeros(3, 2))
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), [[2**0.5, 2.0]] * 3, rtol=1e-6)


def test_the_first_inputs_count_and_infusions_are_off() -> None:
    text = "input u linear\nstate x = 1\nstate y = 1\nx' = u - x\ny' = x - y\ndose x over 2\ninitial steady\n"
    one = evaluator_of(text)
    course = Signal(np.array([0.0, 2.0]), np.array([1.0, 3.0]))
    off = Signal(np.array([0.0]), np.array([5.0]))
    assert one.instance.inputs[0] == "u" and len(one.instance.inputs) == 2
    np.testing.assert_allclose(one.initial([0.0, 0.0], (), None, (course, off), 1.0), [2.0, 2.0], rtol=1e-12)


def test_a_single_state_with_the_others_at_their_starts() -> None:
    one = evaluator_of("state x = 1\nstate y = 1\nx' = y - x\ny' = -y\ninitial x steady\ninitial y = 4\n")
    np.testing.assert_allclose(one.initial([0.0, 0.0]), [4.0, 4.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("balances", "reason"),
    [
        ("x' = y\ny' = -x", "does not come to rest"),
        ("x' = 1\ny' = -y", "does not come to rest"),
        ("x' = x^2 + 1\ny' = -y", "does not come to rest"),
        ("x' = y*x - y*x^2\ny' = -y", "singular"),
    ],
)
def test_where_there_is_none_it_says_why(balances: str, reason: str) -> None:
    one = evaluator_of(f"state x = 0.4\nstate y = 1\n{balances}\ninitial steady\n")
    with pytest.raises(ComputationError, match=r"no steady start of `[xy]`") as found:
        one.initial([0.0, 0.0])
    assert reason in found.value.what
    with pytest.raises(ArithmeticError, match=r"no steady start of `[xy]` in row 0"):
        one.instance.initial([0.0, 0.0])


def test_some_start_so_and_states_are_set_then() -> None:
    """x goes to sqrt(c), with c held at 4; then both are set, from the values before."""
    text = """condition c
condition rested
state x = 0.5
state y = 3
x' = c - x^2
y' = x - y
initial steady with c = 4 then x = y + c, y = 10*x when rested > 0
"""
    one = evaluator_of(text)
    np.testing.assert_allclose(one.initial(np.zeros(2), [7.0, 1.0]), [9.0, 20.0], rtol=1e-12)
    np.testing.assert_allclose(one.initial(np.zeros(2), [7.0, 0.0]), [0.5, 3.0], rtol=1e-15)
    found = one.instance.initial(torch.zeros(3, 2).double(), [[7.0, 1.0], [7.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(found.numpy(), [[9.0, 20.0], [0.5, 3.0], [3.0, 20.0]], rtol=1e-12)


def test_who_does_not_start_so_needs_no_steady_state() -> None:
    one = evaluator_of("condition c\nstate x = 1\nx' = c - x^2\ninitial steady when c > 0\n")
    assert one.initial([0.0], [-1.0])[0] == 1.0
    assert one.instance.initial([[0.0]] * 2, [[-1.0], [4.0]]).ravel().tolist() == pytest.approx([1.0, 2.0])


ONCE = """learn k = 2
learn b = 0.5
state x = 1
discrete on = 0
x' = k*(1 + on) - b*x^2
event tip when x > 1.5 and on < 0.05: on = b, x = x/2
initial steady
"""


def test_events_happen_on_the_way() -> None:
    """At rest k*(1 + b) = b*x^2, with the derivatives of that."""
    one = evaluator_of(ONCE)
    assert one.initial(np.zeros(2)) == pytest.approx([6**0.5, 0.5], rel=1e-12)
    k = torch.tensor([2.0, 0.5], dtype=torch.float64, requires_grad=True)
    start = one.instance.initial(torch.zeros(2).double(), constants={"k": k[0], "b": k[1]})
    assert start[0].item() == pytest.approx(6**0.5, rel=1e-12)
    (slopes,) = torch.autograd.grad(start[0], k)
    np.testing.assert_allclose(slopes, [3 / 2 / 6**0.5, -2 / 0.25 / 2 / 6**0.5], rtol=1e-9)


def test_what_stays_where_it_stops_has_the_derivatives_of_its_way() -> None:
    """b keeps what a has lost when a = 1/2, and half of it again: 2*(s - 1/2), once."""
    one = evaluator_of(
        "learn s = 2\nstate x = 1\nstate b = 0\ndiscrete on = 1\ninitial x = s\ninitial b = 0\n"
        "x' = -on*x\nb' = on*x\nevent stop when x < 0.5: on = 0, b = 2*b\ninitial steady\n"
    )
    s = torch.tensor([2.0], dtype=torch.float64, requires_grad=True)
    start = one.instance.initial(torch.zeros(3).double(), constants={"s": s[0]})
    np.testing.assert_allclose(start.detach(), [0.5, 3.0, 0.0], rtol=1e-8)
    assert float(torch.autograd.grad(start[1], s)[0]) == pytest.approx(2.0, rel=1e-7)
    single = one.instance.initial(torch.zeros(3))
    np.testing.assert_allclose(single, [0.5, 3.0, 0.0], rtol=1e-4)


def test_events_without_an_end_have_no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    one = evaluator_of("state x = 1\nx' = 2 - x\nevent tip when x > 1.5: x = x/2\ninitial steady\n")
    monkeypatch.setattr(sys.modules[type(one.instance).__module__], "_PATIENCE", 60)
    with pytest.raises(ComputationError, match=r"`x`: the solution .* with its events, does not come to rest"):
        one.initial([0.0])
