"""Comparisons at which right-hand sides jump, and those at which they have a kink."""

from __future__ import annotations

import pytest

from gbspec.passes import with_switches
from tests.training.conftest import model_of

TEXT = """model m
time t
state x
state y
learn k = 1 in [0.1, 2]
learn n = 2 in [1, 4]
learn a = 1 in [-1, 2]
let r = 1/x
x' = {}
y' = -y + 0*r
observe x
"""


@pytest.mark.parametrize(
    "value",
    [
        "if(x > 0, x/(0.5 + x), 0)",
        "if(x > 0, x^n/(0.5^n + x^n), 0)",
        "if(x > 0.3, 0.1*x, 0.03)",
        "if(x < 1, x, if(x < 2, 1, 3 - x))",
        "if(x/k > 1, x - k, 0)",
        "if(x > 0 and y > 0, x*y, 0)",
        "if(t > a, t - a, 0)",
    ],
)
def test_branches_that_agree_have_a_kink(value: str) -> None:
    found = with_switches(model_of(TEXT.format(value)))
    assert found.model is not None and not found.jumps


@pytest.mark.parametrize(
    "value",
    [
        "if(x > 0, 1, 0)",
        "if(x < 1, x, if(x < 2, 1, 4 - x))",
        "if(y*(x - 1) > 0, x - 1, 0)",  # also where y passes zero
        "if(x > 0 and y > 0, x, 0)",  # where y passes zero
        "if(x > a, sign(x - a), 0)",
        "if(x > 1, (x^2 - 1)/(x - 1), 0)",
        "if(x > 0, x*r, 0)",
        "if(x > 0, x^a, 0)",
        "if(x > 0, if(1/x > 2, x, 1), 0)",
        "if(x > 0, if(x == 0, 0, 1), 0)",
        "if(if(x > 0, 1, 0) > 0.5, 1, 2)",
    ],
)
def test_what_is_not_shown_to_agree_jumps(value: str) -> None:
    assert with_switches(model_of(TEXT.format(value))).jumps


def test_what_is_skipped_is_told_apart_from_jumps() -> None:
    kinks = with_switches(model_of(TEXT.format("if(x > 0.5, 1, 2) + max(x, mod(t, 2))")))
    assert kinks.jumps and kinks.skipped and not kinks.skipped_jumps and not kinks.unknown_jumps
    jumps = with_switches(model_of(TEXT.format("max(x, 1) + if(x > mod(t, 2), 1, 2)")))
    assert not jumps.jumps and jumps.skipped == jumps.skipped_jumps and "decides" in jumps.unknown_jumps
