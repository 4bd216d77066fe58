"""Unmeasured states whose scale or origin only unknown functions fix (GB407)."""

from __future__ import annotations

import pytest

from gbspec.diagnostics import Findings
from gbspec.passes.identifiability import identifiability
from tests.texts import model_of

BATTERY = "state soc in [0, 1]\ninput I held\nunknown ocv(soc)\nsoc' = -I/2.3\nobserve V = ocv(soc)\n"
PREY = "state x\nstate y\nunknown eaten(x, y)\nunknown grown(x, y)\nx' = 0.5*x - eaten\ny' = grown\nobserve x\n"
TANKS = "input F held\nstate h1\nstate h2\nunknown q1(h1) {}\nunknown q2(h2)\nh1' = F - q1\nh2' = q1 - q2\nobserve h2\n"
CHAIN = "state a\nstate b\nstate c\nunknown f(a)\na' = -f\nb' = a - b\nc' = b - c\nobserve c\n"

CASES: dict[str, tuple[str, dict[tuple[str, ...], str]]] = {
    "battery": (BATTERY, {("soc",): "soc -> soc + c, ocv -> ocv(soc - c)"}),
    "two functions of the state": (
        BATTERY.replace("observe V = ocv(soc)", "unknown r(soc)\nobserve V = ocv(soc) - I*r(soc)"),
        {("soc",): "soc -> soc + c, ocv -> ocv(soc - c), r -> r(soc - c)"},
    ),
    "known start": (BATTERY + "initial soc = 1\n", {}),
    "measured": (BATTERY + "observe soc\n", {}),
    "known form": (BATTERY.replace("unknown ocv(soc)", "learn e = 1").replace("ocv(soc)", "3 + e*soc"), {}),
    "predators": (
        PREY,
        {
            ("y",): "y -> c*y, grown -> c*grown(x, y/c), eaten -> eaten(x, y/c); "
            "y -> y + c, eaten -> eaten(x, y - c), grown -> grown(x, y - c)"
        },
    ),
    "the inflow fixes the scale of the level": (TANKS.format(""), {("h1",): "h1 -> h1 + c, q1 -> q1(h1 - c)"}),
    "a zero fixes the origin": (TANKS.format("zero at h1 = 0"), {}),
    "known outputs of a chain": (CHAIN, {}),
}  # fmt: skip


def free(text: str) -> tuple[dict[tuple[str, ...], str], Findings]:
    findings = Findings()
    found = identifiability(model_of(text), findings)
    return {one.states: one.transformation for one in found.sets if one.states}, findings


@pytest.mark.parametrize("name", CASES)
def test_the_transformation_is_named(name: str) -> None:
    text, expected = CASES[name]
    found, findings = free(text)
    assert found == expected
    assert [d.code for d in findings] == ["GB407"] * len(expected)


def test_it_can_be_accepted() -> None:
    found, findings = free(BATTERY + "allow GB407 soc\n")
    assert found and not list(findings)
