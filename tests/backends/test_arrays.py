"""Arrays of states computed as vectors: the same numbers as written out, in every library, in text that stays short."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gbspec.backends.c import c_code
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.latex import document
from gbspec.backends.module import generate, load_module
from gbspec.ir.dumping import dump
from gbspec.ir.model import Model
from gbspec.ir.verification import verify
from gbspec.passes import with_truth
from gbspec.report.html import mathml
from tests.backends.test_agreement import RANDOM, check_agreement, check_derivatives, check_step, close, instance_of
from tests.strategies import point
from tests.texts import model_of

Array = NDArray[np.float64]

TUBE = """model tube "Two arrays, a scalar state, sums, ends of all kinds, choices, several unknowns"
time t from 0
const N = 5
const L = 2
const h = L/N
condition v in [0.1, 2]
input feed held
learn D = 0.01 in [0, 1]
learn k = 0.5 in [0.1, 2]
function up(a, b, dx) = (a - b)/dx
let load = sum(c)*h + q(T[1], 0.5)
state c[0..N] in [0, 2] = 0.1 "concentration"
state w in [0, 1] = 0.2
state T[1..2*N] in [0, 3] = 1
unknown r, s(x, y) by mlp(5, 4)
unknown q(x, y) = k*x/(1 + x)*nn by mlp(3)
unknown m(x) by mlp(4)
c[i]' = D*(c[i-1] - 2*c[i] + c[i+1])/h^2 - v*up(c[i], c[i-1], h) - r(c[i], T[2*i+1]) - r(w, v)*q(c[i], w)
  + if(t > 0.1, log(k)*c[i], sqrt(1 + c[i]^2)) - m(c[N-i]) + m(0.5)*c[i]
c[-1] = feed + sin(t)*load
c[N+1] = 2*c[N] - c[N-1]
T[2*N+1] = q(T[2], v)
T[0] = w
T[j]' = up(T[j+1], T[j-1], 2*h)*v - s(T[j], w)*j/N + if(j > 3, T[j]*load, 0.5) - q(2, 0.1)*T[j] + sum(c)
w' = load - w*c[3]
initial c[i] = k*i/N + w
initial w = 0.3
initial T[2] = c[1]
observe c
observe w
observe T[3]
observe mean = sum(T)/10 + load
truth r(x, y) = x*y
truth s(x, y) = x - y
truth q(x, y) = k*x + y
truth m(x) = x
"""


def written_out(model: Model) -> Model:
    """The same model with one expression a state."""
    return dataclasses.replace(model, arrays=(), families=())


# ---------------------------------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize("known", [False, True])
def test_all_that_the_language_has_agrees_with_the_symbolic_truth(known: bool) -> None:
    model = with_truth(model_of(TUBE)) if known else model_of(TUBE)
    verify(model)
    assert {f.vector for f in model.families} == {"balances", "starts", "channels", "intermediates"}
    at = point(model, 5)
    check_agreement(model, at, 3)
    check_derivatives(model, at, 3)
    check_step(model, at, 3)


@st.composite
def array_models(draw: st.DrawFn) -> str:
    """A random model: neighbours near and far, ends of several kinds, an index as a number, sums, an unknown."""
    first, count = draw(st.integers(-2, 3)), draw(st.integers(1, 7))
    last, reach = first + count - 1, draw(st.integers(1, 3))
    ends = ["cin", "w", "0", f"c[{first}]", f"2*c[{last}] - 1", "cos(t)*D", "sum(c)", f"r(c[{last}], w)"]
    lines = ["model m", "learn D = 0.3 in [0, 1]", "condition cin", f"state c[{first}..{last}]", "state w"]
    if draw(st.booleans()):
        lines[3:] = ["state w", lines[3]]
    lines.append("unknown r, z(x, y)" + draw(st.sampled_from(["", " = D*x + nn"])) + " by mlp(3)")
    terms = draw(
        st.lists(
            st.sampled_from(
                (
                    *(f"c[i{shift:+d}]" for shift in range(-reach, reach + 1)),
                    *("i*c[i]", "D*w", "r(c[i], w)", "r(c[i], i)", "z(c[i-1], c[i+1])", "cin^2*sum(c)", "-t", "2"),
                    *(
                        "max(c[i], w)",
                        "if(c[i] < w, c[i]^2, sqrt(1 + w^2))",
                        "if(w > 1, D, r(w, 2)*c[i])",
                        "abs(D - i)",
                    ),
                    f"c[{first + last} - i]",
                )
            ),
            min_size=1,
            max_size=5,
        )
    )
    lines.append("c[i]' = " + " + ".join(f"{0.1 * (n + 1):.1f}*({term})" for n, term in enumerate(terms)))
    outside = [*range(first - reach - 1, first), *range(last + 1, last + reach + 2)]
    lines += [f"c[{k}] = {draw(st.sampled_from(ends))}" for k in outside]
    lines += [
        "w' = sum(c) - w",
        *draw(st.sampled_from([["observe c"], [f"observe c[{last}]", "observe s = sum(c) + w"]])),
    ]
    lines += draw(st.sampled_from([[], ["initial c[i] = D*i", "initial w = cin"], [f"initial c[{first}] = cin"]]))
    return "\n".join([*lines, ""])


@settings(RANDOM, max_examples=15)
@given(array_models(), st.integers(0, 2**16))
def test_random_arrays_agree_with_what_they_are_written_out(text: str, seed: int) -> None:
    model = model_of(text)
    verify(model)
    assert any(family.vector == "balances" for family in model.families)
    at = point(model, seed)
    short, long = (instance_of(m, seed, at.constants) for m in (model, written_out(model)))
    wanted = long.rhs(at.t, at.x, at.condition).numpy()
    m, constants = short.arithmetic("numpy"), tuple(map(np.float64, at.constants))
    with np.errstate(all="ignore"):
        close(
            short.equations.rhs(m, at.t, at.x, at.condition, at.inputs, constants, short.numpy_networks()),
            wanted,
            "numpy",
        )
    close(Evaluator(short).rhs_many(at.t, at.x, at.condition)[0], wanted, "casadi")
    close(short.observe(at.t, at.x, at.condition), long.observe(at.t, at.x, at.condition), "channels")
    close(short.initial(at.x, at.condition), long.initial(at.x, at.condition), "starts")
    close(Evaluator(short).initial(at.x, at.condition), long.initial(at.x, at.condition), "starts by numpy")
    jacobian = Evaluator(long).jacobian_at(at.t, at.x, at.condition)
    close(Evaluator(short).jacobian_at(at.t, at.x, at.condition), jacobian, "casadi's Jacobian")
    x = torch.tensor(np.random.default_rng(seed).normal(size=(3, 2, len(at.x))), requires_grad=True)
    slopes = []
    for instance in (short, long):
        out = instance.rhs(at.t, x, np.tile(at.condition, (3, 2, 1)))
        slopes.append((out.detach(), torch.autograd.grad((out * out.detach().cos()).sum(), x)[0]))
    close(slopes[0][0], slopes[1][0], "a batch")
    close(slopes[0][1], slopes[1][1], "its gradient")


def test_arrays_of_different_lengths_with_one_running_index() -> None:
    model = model_of(
        "model m\nstate c[1..6]\nstate d[1..3]\nc[i]' = c[i+1] - i*c[i]\nd[i]' = c[i+1]*d[i] + c[2*i] - d[i+1]*i\n"
        "c[7] = 1\nd[4] = c[1]\nobserve c\nobserve d\n"
    )
    assert len(model.families) == 4
    check_agreement(model, point(model, 3), 3)


def test_contracts_hold_their_form_for_vectors() -> None:
    text = TUBE.replace("unknown m(x) by mlp(4)", "unknown m(x in [0, 3]) >= 0, increasing in x\n  by mlp(4)")
    model = model_of(text)
    at = point(model, 2)
    short, long = (instance_of(m, 2, at.constants) for m in (model, written_out(model)))
    args: tuple[Any, ...] = (at.t, at.x, at.condition, at.inputs)
    close(short.rhs(*args), long.rhs(*args), "torch")
    close(Evaluator(short).rhs_many(*args), Evaluator(long).rhs_many(*args), "casadi")
    batch = np.stack([at.x, 2 * at.x])
    close(short.rhs(at.t, batch, at.condition, at.inputs), long.rhs(at.t, batch, at.condition, at.inputs), "a batch")


# ---------------------------------------------------------------------------------------------------------- text


def test_text_has_as_many_lines_for_many_states() -> None:
    few, many = (model_of(TUBE.replace("const N = 5", f"const N = {n}")) for n in (8, 40))
    for make in (generate, document, lambda m: "\n".join(map(str, mathml.balances(m)))):
        assert make(few).count("\n") == make(many).count("\n")
    assert abs(len(generate(many)) - len(generate(few))) < 200


def test_each_unknown_is_called_once_for_an_array() -> None:
    model = model_of("model m\nstate c[1..50]\nunknown r(x) by mlp(4)\nc[i]' = -r(c[i])\nobserve c\n")
    calls: list[tuple[int, ...]] = []
    instance = load_module(model).random(0)

    def network(x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        calls.append(tuple(x.shape))
        return (x,)

    instance.equations.rhs(instance.arithmetic("torch"), 0.0, torch.ones(3, 50), None, None, (), (network,))
    assert calls == [(3, 50)]


def test_other_forms_of_the_model() -> None:
    model = model_of(TUBE)
    text = dump(model)
    assert "c[0..5] from state 0" in text
    assert "intermediates 0 to 0: h*Total(c) + q(T_1, 0.5)" in text
    page = document(model)
    assert r"\frac{\mathrm{d} c_{i}}{\mathrm{d} t}" in page
    assert r"\sum_{i} c_{i}" in page
    assert "<msub><mi>c</mi>" in str(mathml.balances(model))
    code = c_code(load_module(with_truth(model))())
    assert "jacobian(t [1], x [17]" in code


def test_an_index_that_is_not_linear_stays_written_out() -> None:
    model = model_of("model m\nstate c[1..4]\nc[i]' = -c[(i - 2)^2 + 1 - (i - 3)*0] \nc[5] = 0\nobserve c\n")
    assert [family.vector for family in model.families] == ["channels"]
    check_agreement(model, point(model, 1), 1)
