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


def test_expansions_of_high_order_have_values() -> None:
    """25! is no whole number of 64 bits."""
    algebra = Algebra(25, 0)
    line = algebra.constant(np.array([0.5]))
    line[..., algebra.index[0, 1]] = 1.0
    assert algebra.exp(line)[0, algebra.index[0, 25]] == pytest.approx(np.exp(0.5) / math.factorial(25))
    assert algebra.wave(line, 0)[0, algebra.index[0, 25]] == pytest.approx(np.cos(0.5) / math.factorial(25))
