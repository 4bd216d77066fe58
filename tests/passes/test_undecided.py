"""Every answer "undecided" says what was tried, and what would decide it."""

from __future__ import annotations

from functools import cache

import pytest

from gbspec.cli.commands.check import examination_summary, identifiability
from gbspec.diagnostics import Findings
from gbspec.passes import Examination, examine
from tests.texts import model_of

SIR = (
    "model m\ntime t from 0\nconst N = 763\nstate S in [0, 763]\nstate I in [0, 763]\nlearn gamma = 0.5 in [0.05, 5]\n"
    "learn rho = 0.5 in [0.05, 1]\nlearn I0 = 3 in [0.1, 30]\n"
    "unknown force(I) >= 0, zero at I = 0, increasing in I by mlp(8, 8)\n"
    "process infection: S -> I rate force*S\nprocess recovery: I -> rate gamma*I\n"
    "initial S = N - I0\ninitial I = I0\nobserve cases = rho*I\n"
)
UNDECIDED = "identifiability of the learned constants could not be decided"


@cache
def examination(text: str) -> Examination:
    return examine(model_of(text), Findings())


def summary(text: str) -> str:
    return examination_summary(examination(text))


def test_a_force_of_infection_from_a_known_start_says_what_decides_it() -> None:
    told = summary(SIR)
    assert f"{UNDECIDED}: from a known start `force` can follow any solution until it comes back" in told
    assert "leave out `initial I = I0` and write `initial S = -I + N`, or make them depend on a `condition`" in told
    free = (
        SIR.replace("initial I = I0\n", "").replace("= N - I0", "= -I + N").replace("learn I0 = 3 in [0.1, 30]\n", "")
    )
    assert UNDECIDED not in summary(free)
    given = SIR.replace("learn I0 = 3 in [0.1, 30]\n", "condition I0 in [0.1, 30]\n")
    assert UNDECIDED not in summary(given)


def test_json_has_the_reasons() -> None:
    answer = identifiability(examination(SIR))
    assert answer["decided"] is False
    (reason,) = answer["reasons"]  # type: ignore[misc]
    assert reason.startswith("from a known start")
    known = "model m\nstate x\nlearn k = 1\nx' = -k*x\nobserve x\n"
    assert identifiability(examination(known))["reasons"] == []


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("event low when x < 0.1: x = 1\n", "models with events are not examined; the intervals of a fit"),
        ("algebraic z\nequation e: x = z + z^3\n", "models with searched algebraic variables are not examined"),
    ],
)
def test_what_is_not_examined_is_named(text: str, reason: str) -> None:
    model = "model m\nstate x in [0, 9] = 1\nlearn k = 1 in [0.1, 3]\nx' = -k*x\nobserve x\n" + text
    assert f"{UNDECIDED}: {reason}" in summary(model)


def test_more_states_than_are_examined() -> None:
    states = "".join(f"state x{i}\nx{i}' = -k*x{i}\nobserve x{i}\n" for i in range(41))
    assert f"{UNDECIDED}: models of more than 40 states" in summary("model m\nlearn k = 1\n" + states)


def test_formulas_without_values_are_named() -> None:
    text = "model m\nstate x in [1, 2]\nlearn k = 1\nx' = -k*log(-x)\nobserve x\n"
    assert f"{UNDECIDED}: its formulas have no finite values" in summary(text)


def test_a_state_whose_logarithm_is_observed_is_not_said_to_be_unmeasured() -> None:
    text = (
        "model m\ntime t from 0\ncondition ttx in [1, 9]\nstate U in [0, 1]\nstate I in [0, 10]\nstate V in [0, 1e5]\n"
        "learn b = 1e-3 in [1e-6, 1]\nlearn p = 1e3 in [1, 1e7]\nlearn dI = 2 in [0.1, 20]\nlearn eps = 0.9 in [0, 1]\n"
        "unknown s(U)\nlearn V0 = 0.1 in [1e-4, 50]\nlet on = if(t > ttx, 1, 0)\n"
        "initial U = 1\ninitial I = 0\ninitial V = V0\nU' = s - b*U*V\nI' = b*U*V - dI*I\nV' = (1 - eps*on)*p*I - 5*V\n"
        "observe logV = log10(max(V, 1e-6))\n"
    )
    assert "it would help to observe `U` or `I`;" in summary(text)
