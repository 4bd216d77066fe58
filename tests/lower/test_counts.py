"""Counts that an event empties: what the refusal of their noise (GB351) says can be written."""

from __future__ import annotations

import re

import pytest

from gbspec.diagnostics import Diagnostic
from gbspec.lower import lower
from tests.texts import checked, model_of

EPIDEMIC = (
    "model m\ntime t : day from 0\nconst N = 763\nstate S in [0, 763]\nstate I in [0, 763]\nstate C in [0, 763]\n"
    "learn beta = 1 in [0.05, 10]\nlearn gamma = 0.5 in [0.05, 5]\nlearn k = 0.1 in [0.01, 1]\n"
    "S' = -beta*S*I/N\nI' = beta*S*I/N - gamma*I\nC' = beta*S*I/N\n"
    "initial S = N - 1\ninitial I = 1\ninitial C = 0\n"
)
WEEK = "event week every 7: C = 0\n"
NOISE = " noise normal(sqrt(1 + y + (k*y)^2))\n"


def refusal(text: str) -> Diagnostic:
    result, findings = checked(text)
    assert result is not None
    lower(result, findings)
    (error,) = findings.errors
    return error


def test_the_lines_of_the_help_compile() -> None:
    error = refusal(EPIDEMIC + WEEK + "observe cases = C" + NOISE)
    assert error.code == "GB351"
    assert "without `event week`, `observe cases` may have such a noise with the rate of `C` in place" in error.help
    found = re.search(r"\(`([^`]+)`, what is counted", error.help)
    assert found is not None
    assert found[1] == "beta*S*I/N"
    for observed in (found[1], "C"):
        model_of(f"{EPIDEMIC}observe cases = {observed}{NOISE}")
    for noise in (" noise normal(5)\n", " noise lognormal(0.2)\n"):
        model_of(f"{EPIDEMIC}{WEEK}observe cases = C{noise}")


@pytest.mark.parametrize(
    ("noise", "why"), [("sqrt(1 + y)", "depends on the predicted value"), ("k", "holds learned constants")]
)
def test_the_reason_is_that_of_the_noise(noise: str, why: str) -> None:
    error = refusal(f"{EPIDEMIC}{WEEK}observe cases = C noise normal({noise})\n")
    assert error.message == f"the noise of `cases` {why}, which events do not offer yet"


def test_where_no_event_empties_the_count_there_is_no_advice_on_it() -> None:
    error = refusal(f"{EPIDEMIC}event stop when I < 0.1: I = 0\nobserve cases = C{NOISE}")
    assert error.help.endswith("or leave out the events")
