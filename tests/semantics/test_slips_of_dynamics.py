"""Likely mistakes in dynamic statements (events, equations, delays, tables, categories, infusions, splines), through
every check: each gives one diagnostic, at its place, whose help or label says what to write."""

from __future__ import annotations

from pathlib import Path

import pytest

from gbspec.diagnostics import Span
from tests.semantics.test_slips import findings_of

RIGHT = {
    "room": """model room "A room with a thermostat"
time t : h from 0
state T : K in [270, 320] = 290
discrete on : 1 = 0 "whether the heater is on"
discrete outside : K = 281
learn low : K = 291 in [285, 293]
learn high : K = 295 in [294, 300]
T' = (outside - T)/(4 in h) + on*(6 in K/h)
initial T = 288
event start when T <= low: on = 1
event stop when T >= high: on = 0 "the upper threshold"
event dusk at 9 every 24 until 100: outside = 277
event late when T >= high after 0.5: outside = 280
observe T
""",
    "tank": """model tank "A neutralisation"
state acid in [0, 0.1] = 0.04
state sodium in [0, 0.1] = 0.03
learn pKa = 5.5 in [3, 7]
algebraic pH in [0, 14] = 7
table feed(s) = (0, 0.1), (0.5, 0.2), (1, 0.4) pchip outside hold "feed"
acid' = feed(sodium) - acid
sodium' = 0.05 - sodium
equation charge: sodium + 10^(-pH) = 10^(pH - 14) + acid/(1 + 10^(pKa - pH))
initial acid = 0.04
initial sodium = 0.03
observe pH
""",
    "cells": """model cells "Delayed release"
time t : h from 0
state P : 1 in [0, 2]
learn tau : h = 12 in [5, 40]
learn gamma : 1/h = 0.1 in [0.01, 1]
unknown production(P in [0, 2]) : 1/h >= 0 by spline(12)
P' = production(delay(P, tau)) - gamma*P
history P = 0.5
observe P
""",
    "growth": """model growth "Two strains"
time t : h from 0
condition strain in {"wild type", mutant}
state X : g/L in [0, 20] = 0.1
learn mu : 1/h = 0.3 in [0.01, 2] per strain
X' = mu*X
observe X noise normal(0.1)
observe speed = X' noise normal(0.01)
""",
    "drip": """model drip "Infusions"
time t : h from 0
input F : mg/h held
state gut : mg in [0, 100] = 0
state blood : mg in [0, 100] = 0
learn ka : 1/h = 1 in [0.1, 10]
learn ke : 1/h = 0.1 in [0.001, 10]
learn bio = 0.5 in [0, 1]
dose gut times bio
dose blood over 0.5
gut' = -ka*gut
blood' = ka*gut - ke*blood + F
initial steady with F = 0
observe blood noise normal(1)
""",
}
SLIPS = [
    line.split("\t") for line in (Path(__file__).parent / "slips_of_dynamics.tsv").read_text("utf-8").splitlines()[1:]
]


@pytest.mark.parametrize("model", RIGHT)
def test_the_right_models_are_right(model: str) -> None:
    assert not list(findings_of(RIGHT[model]))


def test_there_are_at_least_sixty_mistakes() -> None:
    assert len({(model, slip) for model, *_, slip, _ in SLIPS}) == len(SLIPS) >= 60


@pytest.mark.parametrize(
    ("model", "code", "line", "marked", "right", "slip", "says"), SLIPS, ids=[slip for *_, slip, _ in SLIPS]
)
def test_a_mistake_is_one_diagnostic_that_says_what_to_write(
    model: str, code: str, line: str, marked: str, right: str, slip: str, says: str
) -> None:
    assert right in RIGHT[model]
    (finding,) = findings_of(RIGHT[model].replace(right, slip, 1))
    assert isinstance(finding.place, Span)
    assert (finding.code, finding.place.position[0], finding.place.text) == (code, int(line), marked)
    assert says and says in f"{finding.help} {finding.label}"
