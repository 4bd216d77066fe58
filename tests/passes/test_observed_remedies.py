"""Of hidden states only those are to be observed that let a set be learned."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from gbspec.passes.identifiability import identifiability
from tests.texts import model_of

CELL = """model m
time t from 0
input I held
state q in [-0.05, 1.05] = 1
state v in [-5, 5] = 0
learn Q = 30 in [29, 40]
learn tau = 60 in [2, 2000]
unknown ocv(q in [0, 1]) by mlp(8)
q' = I/Q
v' = -v/tau + I
initial q = 1
initial v = 0
observe V = ocv(q)
"""
SUM = """model m
state a
state b
state c
learn k = 1
learn s = 1
a' = -k*a
b' = -2*b
c' = -c
observe c
observe y = s*(a + b)
"""
NOTHING = SUM.replace("observe y", "initial a = 0\nobserve y").replace("+ b)", "+ k*a)")
MANY = "model m\nstate x\nlearn s = 2\nx' = -x\nobserve y = s*x\n" + "".join(
    f"state z{i}\nz{i}' = -z{i}\n" for i in range(8)
)


def remedies(text: str) -> dict[str, str]:
    """The first remedy of each warning, by its first name."""
    findings = Findings()
    identifiability(model_of(text), findings)
    return {one.subject: one.help.split("; or")[0] for one in findings if one.help is not None}


@pytest.mark.parametrize(
    ("text", "first"),
    [
        (CELL, {"Q": "observe `q`", "tau": "observe `v`"}),
        (CELL + "observe v\n", {"Q": "observe `q`"}),
        (CELL + "observe q\n", {"tau": "observe `v`"}),
        (SUM, {"s": "observe `a` or `b`"}),
        (NOTHING, {"k": "give `k` a value (`const`) or a prior"}),
    ],
)
def test_what_does_not_help_is_not_offered(text: str, first: dict[str, str]) -> None:
    found = remedies(text)
    assert {name: found.get(name) for name in first} == first


def test_of_many_states_what_may_help_is_named() -> None:
    assert remedies(MANY)["s"].endswith("or `z7`, which may help")
