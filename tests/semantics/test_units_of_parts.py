"""A name that stands for several, of an array or of categories, is told of once, as it is written."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from tests.texts import checked

CATEGORIES = (
    "model m\ntime t : day\ncondition variety in {F, P}\nstate W : g\nlearn k = 1 in [0.2, 5] per variety\n"
    "learn mu = 0.1\nW' = k*mu*W\nobserve W\n"
)
CHAIN = (
    "model m\ntime t : day\nstate x[1..3]\nstate y : g\nconst r : 1/day = 2\nx[i]' = -r*x[i]\ny' = -r*y\n"
    "observe x[1]\nobserve y\n"
)
HEATER = (
    "model m\ntime t : h\nstate x : K\nconst r : K/h = 2\ndiscrete on = 1\nevent off at 20: on = 0\nx' = r\nobserve x\n"
)


def told(text: str) -> list[tuple[str, str]]:
    """The names without a unit, and what to write."""
    _, findings = checked(text)
    assert not Findings(findings).failed
    return [(d.message.split(" has ")[0], d.help.split(" (a ")[0]) for d in findings if d.code == "GB550"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CATEGORIES, [("`k`", "declare it: `learn k : UNIT`")]),
        (CHAIN, [("`x[1..3]`", "declare it: `state x[1..3] : UNIT`")]),
        (HEATER, [("`on`", "declare it: `discrete on : UNIT = …`")]),
        (CATEGORIES + "allow GB550 k\n", []),
        (CHAIN + "allow GB550 x\n", []),
    ],
)
def test_the_advice_can_be_written(text: str, said: list[tuple[str, str]]) -> None:
    assert told(text) == said


def test_the_unit_may_be_declared_as_advised() -> None:
    assert told(CATEGORIES.replace("learn k", "learn k : 1")) == []
    assert told(CHAIN.replace("x[1..3]", "x[1..3] : g")) == []
    assert told(HEATER.replace("on = 1", "on : 1 = 1")) == []
