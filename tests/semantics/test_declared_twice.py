"""A name that is declared twice, by any two statements, gets diagnostics."""

from __future__ import annotations

from itertools import product

import pytest

from tests.texts import codes

DECLARED = {
    "state": "state a : 1\na' = -a",
    "states": "state a[1..3] : 1\na[i]' = -a[i]",
    "condition": "condition a : 1",
    "input": "input a : 1 held",
    "const": "const a : 1 = 2",
    "learn": "learn a : 1 = 2",
    "effect": "effect a per trajectory",
    "let": "let a = 3",
    "function": "function a(z) = 2*z",
    "unknown": "unknown a(x) : 1/d by mlp(4)",
    "outputs": "unknown b, a(x) : 1/d by mlp(4)",
    "process": "process a: x -> 0 rate x",
    "unit": 'unit a "a unit"',
    "time": "time a : d",
}


@pytest.mark.parametrize(("first", "second"), [*product(DECLARED, repeat=2)])
def test_a_name_is_declared_once(first: str, second: str) -> None:
    text = f"model m\nstate x : 1\n{DECLARED[first]}\n{DECLARED[second]}\nobserve x\n"
    assert codes(text), "at least one diagnostic, and no defect"
