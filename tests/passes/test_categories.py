"""Identifiability of models whose conditions choose between categories and between formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gbspec.diagnostics import Findings
from gbspec.passes.identifiability import Identifiability, identifiability
from gbspec.passes.identifiability.report import BUDGET
from gbspec.passes.identifiability.series import Algebra
from tests.texts import model_of


def answer(text: str, budget: float = BUDGET) -> tuple[Identifiability, list[str]]:
    """What is found, and the codes of its warnings."""
    findings = Findings()
    found = identifiability(model_of("model m\n" + text), findings, budget)
    return found, [d.code for d in findings]


@pytest.mark.parametrize("categories", ["{F, P}", "{F, P, Q}", "{F, P} = F"])
@pytest.mark.parametrize("balance", ["a - g", "a*g", "-g(a*X)"])
def test_a_condition_that_nothing_depends_on_changes_nothing(categories: str, balance: str) -> None:
    """No expansion varies a category, so that a function of all states is one of everything that varies."""
    text = f"condition v in {categories}\nstate X in [0.1, 9]\nlearn a = 1 in [0, 5]\nunknown g(X)\nobserve X\n"
    found, codes = answer(f"{text}X' = {balance}\n", BUDGET / 20)
    assert found.decided
    assert [each.names for each in found.sets] == [("a", "g")]
    assert codes == ["GB401"]


def test_a_function_of_a_function_of_all_states_is_one_of_everything() -> None:
    text = "state X in [0.1, 9]\nlearn a = 1 in [0, 5]\nunknown g(y)\nunknown h(X)\nobserve X\nX' = a - g(h(X))\n"
    found, codes = answer(text)
    assert found.decided
    assert [set(each.names) for each in found.sets] == [{"a", "g", "h"}]
    assert codes == ["GB401"]


def test_expansions_of_high_order_have_values() -> None:
    """25! is no whole number of 64 bits."""
    algebra = Algebra(25, 0)
    line = algebra.constant(np.array([0.5]))
    line[..., algebra.index[0, 1]] = 1.0
    assert algebra.exp(line)[0, algebra.index[0, 25]] == pytest.approx(np.exp(0.5) / math.factorial(25))
    assert algebra.wave(line, 0)[0, algebra.index[0, 25]] == pytest.approx(np.cos(0.5) / math.factorial(25))


FORMS = "condition v in {F, P}\nstate W in [0.05, 40]\nlearn k = 2 in [0.2, 5]\nunknown mu(W)\nobserve W\n"
LEVEL = FORMS.replace("{F, P}", "[0, 1]")
DRIVEN = FORMS.replace("condition v in {F, P}", "input v in [0, 1] held")
TIMED = FORMS.replace("condition v in {F, P}", "time t from 0")
HIDDEN = FORMS.replace("observe W", "state y in [0, 9]\ny' = W - y\nobserve y")
BOTH = "condition v in {F, P}\nstate X in [0, 9]\nunknown f(X)\nunknown g(X)\nobserve X\n"

TOLD_APART = {
    "a factor of one category": FORMS + "W' = if(v == F, 1, k)*mu\n",
    "a factor of one category, from a known start": FORMS + "W' = if(v == F, 1, k)*mu\ninitial W = 1\n",
    "an addition in one category": FORMS + "W' = mu - if(v == F, 0, k)\n",
    "an addition in one category, hidden": HIDDEN + "W' = mu - if(v == F, 0, k)\n",
    "a factor of small values": LEVEL + "W' = if(v < 0.5, 1, k)*mu\n",
    "a factor of very small values": LEVEL + "W' = if(v < 0.0005, 1, k)*mu\n",
    "a factor below a named threshold": LEVEL + "const low = 0.0005\nW' = if(v < low, 1, k)*mu\n",
    "a factor of no values but one": LEVEL + "W' = if(v == 0.25, 1, k)*mu\n",
    "a factor between thresholds": LEVEL + "W' = if(v > 0.3 and v < 0.301, 1, k)*mu\n",
    "a bound by a condition": LEVEL + "W' = (1 + k*max(v - 0.5, 0))*mu\n",
    "a factor of an input": DRIVEN + "W' = if(v < 0.5, 1, k)*mu\n",
    "a factor of late times": TIMED + "W' = if(t < 5, 1, k)*mu\n",
    "a threshold that conditions shift": LEVEL + "W' = if(W < 20*v, 1, k)*mu\n",
    "a factor of the argument": FORMS + "W' = if(v == F, mu(W), mu(k*W))\n",
    "another argument, and a factor": FORMS + "W' = if(v == F, 1, k)*mu(if(v == F, 1, 2)*W)\n",
    "two functions, of which one category has one": BOTH + "X' = f - if(v == F, 0, 1)*g\n",
    "two functions, added and subtracted": BOTH + "X' = f + if(v == F, -1, 1)*g\n",
}


@pytest.mark.parametrize("name", TOLD_APART)
def test_trajectories_with_other_formulas_show_the_same_function(name: str) -> None:
    found, codes = answer(TOLD_APART[name], 1e9)
    assert found.decided
    assert found.sets == ()
    assert codes == []


INSEPARABLE = {
    "own factors of one category": (
        FORMS + "W' = if(v == F, 1, k*a)*mu\nlearn a = 1 in [0.2, 5] per trajectory\n", {"k", "a"}
    ),
    "a factor of each category": (FORMS + "learn h = 1 in [0.1, 9]\nW' = if(v == F, h, k)*mu\n", {"k", "h", "mu"}),
    "a condition among the arguments": (
        LEVEL.replace("mu(W)", "mu(W, v)") + "W' = if(v < 0.5, 1, k)*mu\n", {"k", "mu"}
    ),
    "a category that has the function alone": (FORMS + "W' = if(v == F, 1, k*mu)\n", {"k", "mu"}),
    "more categories than points beside one": (
        FORMS.replace("{F, P}", "{A, B, C, D, E, F, G, H}").replace("[0.2, 5]", "[0.2, 5] per v") + "W' = k*mu\n",
        {*(f"k_{name}" for name in "ABCDEFGH"), "mu"},
    ),
    "a factor above a threshold of the state": (FORMS + "W' = if(W < 5, 1, k)*mu\nallow GB403 v\n", {"k", "mu"}),
}  # fmt: skip


@pytest.mark.parametrize("name", INSEPARABLE)
def test_what_no_trajectory_tells_apart(name: str) -> None:
    text, names = INSEPARABLE[name]
    found, codes = answer(text, 1e9)
    assert found.decided
    assert [set(each.names) for each in found.sets] == [names]
    assert codes == ["GB401"]


def test_starts_that_differ_leave_it_to_the_data() -> None:
    """Whether the trajectories of both categories reach the same values is up to the data."""
    found, codes = answer(FORMS + "W' = if(v == F, 1, k)*mu\ninitial W = if(v == F, 1, 2)\n")
    assert not found.decided
    assert found.doubtful == ("k",)
    assert codes == []
