"""The time of checking is proportional to the text's length, and no depth of nesting exhausts the stack."""

from __future__ import annotations

import pytest

from tests.effort import calls
from tests.texts import codes, model_of


def network_of_reactions(n: int) -> str:
    lines = ["model large", "learn k = 1 in [0, 10]", "function f(a, b) = a*b/(1 + a)"]
    lines += [f"state x{i} in [0, 10] = 1" for i in range(n)]
    lines += [
        f"process p{i}: x{i} -> 0.5*x{(i + 1) % n} + x{(i + 7) % n} rate k*f(x{i}, x{(i + 3) % n})" for i in range(n)
    ]
    lines += [f"x{i}' = net(x{i}) - 0.1*x{i}" for i in range(0, n, 2)]
    lines += ["observe total = " + " + ".join(f"x{i}" for i in range(n))]
    return "\n".join(lines) + "\n"


def test_growth_is_linear() -> None:
    model_of(network_of_reactions(10))  # initialises the parser and other caches
    small, large = (calls(lambda n=n: model_of(network_of_reactions(n))) for n in (50, 250))
    assert large < 1.5 * 5 * small  # five times the text; a quadratic algorithm would need 25 times the calls


def test_long_chain_of_lets() -> None:
    lines = ["model chain", "state x", "let a0 = x"]
    lines += [f"let a{i} = a{i - 1} + 1" for i in range(1, 3000)]
    assert codes("\n".join([*lines, "x' = -a2999", "observe x", ""])) == []


def test_long_cycle_is_shortened() -> None:
    lines = ["model chain", "state x"]
    lines += [f"let a{i} = a{(i + 1) % 1000} + 1" for i in range(1000)]
    assert codes("\n".join([*lines, "x' = -a0", "observe x", ""])) == ["GB208"]


def test_deep_nest_of_functions_is_refused() -> None:
    lines = ["model nest", "state x", "function f0(y) = sin(y)"]
    lines += [f"function f{i}(y) = f{i - 1}(sin(y))" for i in range(1, 500)]
    assert codes("\n".join([*lines, "x' = -f499(x)", "observe x", ""])) == ["GB236"]


def test_functions_in_a_cycle_are_not_evaluated() -> None:
    circle = "model m\nstate x\nfunction f(y) = g(y - 1)\nfunction g(y) = f(2)\nx' = -f(x)\nobserve x\n"
    assert codes(circle) == ["GB208"]


@pytest.mark.parametrize("step", ["f{0}(y) + f{0}(2)", "f{0}(2*y) + f{0}(2*y + 1)"])
def test_functions_that_grow_too_large_are_evaluated_only_in_part(step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.semantics.constants.MOST_CALLS", 500)
    lines = ["model m", "function f0(y) = y + 1"]
    lines += [f"function f{i}(y) = {step.format(i - 1)}" for i in range(1, 60)]
    text = "\n".join([*lines, "const n = f59(1)", "state c[1..f59(2)]", "c[i]' = -n*c[i]", "observe c[1]", ""])
    found: list[str] = []
    assert calls(lambda: found.extend(codes(text))) < 1_000_000  # there are 2^59 calls in it
    assert found and set(found) <= {"GB236", "GB240", "GB223"}
