"""Identifiability from known starts at which rates cancel, as in a steady state that something ends later."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from gbspec.passes.identifiability import identifiability
from tests.texts import model_of

VIRUS = (
    "state T in [0, 1e7]\nstate VI in [0, 1e7]\nstate VN in [0, 1e7]\nconst N = 480\nconst K = 0.00429\n"
    "learn c = 1 in [0.1, 20]\nlearn delta = 0.3 in [0.05, 5]\nlearn V0 = 1e6 in [1e5, 1e7]\n"
    "T' = K*VI - delta*T\nVI' = -c*VI\nVN' = N*delta*T - c*VN\n"
    "initial VI = V0\ninitial T = K*V0/delta\ninitial VN = 0\nobserve V = VI + VN\n"
)
CHAIN = (
    "state F\nstate A\nstate B\nstate C\nstate y\nlearn d = 0.5 in [0.1, 5]\nlearn e = 0.7 in [0.1, 5]\n"
    "F' = -F\nA' = F - d*A\nB' = d*A - e*B\nC' = e*B - d*C\ny' = d*C - y\n"
    "initial F = 1\ninitial A = 1/d\ninitial B = 1/e\ninitial C = 1/d\ninitial y = 0\nobserve y\n"
)


@pytest.mark.parametrize(
    ("text", "lost"),
    [
        (VIRUS, []),  # infected cells are in balance until treatment stops new infections
        (CHAIN, []),
        (CHAIN.replace("F' = -F", "F' = 0*F"), [("d",), ("e",)]),
    ],
)
def test_a_balance_at_the_start_hides_constants_from_the_first_derivatives_only(
    text: str, lost: list[tuple[str, ...]]
) -> None:
    findings = Findings()
    found = identifiability(model_of("model m\ntime t from 0\n" + text), findings)
    assert found.decided
    assert [each.names for each in found.sets] == lost
    assert [d.code for d in findings] == ["GB402"] * len(lost)
