"""Identifiability of constants that differ between trajectories, and between categories behind a branch."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from gbspec.passes.identifiability import Identifiability, identifiability
from tests.texts import model_of

GROWTH = "state a in [0.9, 2]\nunknown g(a) >= 0 by mlp(8)\ninitial a = 1\nobserve a noise normal(0.1)\n"


def answer(text: str) -> tuple[Identifiability, Findings]:
    findings = Findings()
    return identifiability(model_of("model m\n" + text), findings, budget=2e9), findings


@pytest.mark.parametrize(
    ("balance", "together"),
    [
        ("learn C = 1 in [0.1, 9] per trajectory ~ lognormal\na' = C*g(a)\n", ("C", "g")),
        ("learn C = 1 in [0.1, 9] per trajectory ~ normal\na' = C + g(a)\n", ("C", "g")),
        ("learn C = 1 in [0.1, 9] per strain ~ lognormal\na' = C*g(a)\n", ("C", "g")),
        ("learn C = 1 in [0.1, 9] per trajectory\na' = C*g(a)\n", ("C", "g")),
        ("learn C = 1 in [0.1, 9] per trajectory\na' = a*g(a/C)\n", ("C", "g")),
    ],
)
def test_a_function_takes_up_what_differing_constants_have_in_common(balance: str, together: tuple[str, ...]) -> None:
    found, findings = answer(GROWTH + balance)
    assert [each.names for each in found.sets] == [together]
    assert [d.code for d in findings] == ["GB401"]


@pytest.mark.parametrize(
    "text",
    [
        GROWTH + "learn w = 0.2 in [0, 2]\neffect e per trajectory\na' = exp(w*e)*g(a)\n",
        GROWTH + "learn C = 1 in [0.1, 9] per trajectory ~ lognormal\na' = C*(g(a) + 1) - 1 - g(a)\n",
        GROWTH.replace("g(a)", "g(a, e in [-3, 3])") + "effect e per trajectory\na' = g\n",
        GROWTH.replace(">= 0", "equals 1 at a = 1") + "learn C = 1 in [0.1, 9] per trajectory\na' = C*g(a)\n",
    ],
)
def test_what_differs_by_a_known_distribution_is_told_apart_from_a_function(text: str) -> None:
    found, findings = answer(text)
    assert found.sets == ()
    assert not list(findings)


def test_the_constant_of_a_category_may_show_in_a_branch_of_time() -> None:
    found, findings = answer(
        "time t from 0\ncondition form in {old, new}\nstate gut in [0, 20]\nstate c in [0, 5]\n"
        "learn ka = 0.8 in [0.05, 10] per form\nlearn lag = 0.4 in [0.01, 0.9]\n"
        "gut' = -if(t > lag, ka, 0)*gut\nc' = if(t > lag, ka, 0)*gut - 0.1*c\n"
        "initial gut = 3\ninitial c = 0\nobserve c\n"
    )
    assert found.sets == ()
    assert {"ka_old", "ka_new", "lag"} <= set(found.doubtful)
    assert not list(findings)


def test_two_distributed_factors_have_no_medians_of_their_own() -> None:
    found, _ = answer(
        "state x\nlearn k = 1 in [0.1, 9] per trajectory ~ lognormal\n"
        "learn q = 1 in [0.1, 9] per trajectory ~ lognormal\nx' = -k*q*x\ninitial x = 1\nobserve x noise normal(0.1)\n"
    )
    assert [set(each.constants) for each in found.sets] == [{"k", "q"}]
