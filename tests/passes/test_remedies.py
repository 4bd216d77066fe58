"""What the help of GB401 says can be written, and then nothing is left to say."""

from __future__ import annotations

import re

import pytest

from gbspec.diagnostics import Diagnostic, Findings
from gbspec.passes.identifiability import identifiability
from tests.texts import model_of

GROWTH = (
    "model m\ntime t : day\ncondition variety in {}\nstate W : g in [0.05, 40]\n{}\n"
    "unknown mu(W) : 1/day >= 0 by mlp(8, 8)\nW' = k*mu*W\nobserve W\n"
)
LEARN = "learn k = 1 in [0.2, 5] per variety"
POPULATION = (
    "model m\ntime t from 0\nstate x in [0, 9]\nlearn k = 1 in [0.1, 9]\n"
    "learn a = 1 in [0.1, 3]{} per trajectory ~ lognormal\nx' = -x\ninitial x = k*a\nobserve x\n"
)


def warnings(text: str) -> list[Diagnostic]:
    findings = Findings()
    identifiability(model_of(text), findings)
    return list(findings)


@pytest.mark.parametrize("categories", ["{F, P}", '{F, "P 2", Q}'])
def test_a_constant_of_each_category_is_fixed_as_the_help_says(categories: str) -> None:
    (warning,) = warnings(GROWTH.format(categories, LEARN))
    assert warning.code == "GB401"
    assert "give `k` a prior (`prior` before `per variety`); or fix that of one category" in warning.help
    written = warning.help.split("in place of `learn k … per variety` write ")[1].split("; or ")[0]
    lines = re.findall(r"`([^`]+)`", written)
    assert lines[0] == "const k_F = 1"
    assert not warnings(GROWTH.format(categories, "\n".join(lines)))
    assert not warnings(GROWTH.format(categories, LEARN.replace("per", "prior normal(1, 0.1) per")))
    assert len({label.span for label in warning.labels}) == len(warning.labels) == 1


def test_the_median_of_a_distribution_gets_a_prior() -> None:
    (warning,) = warnings(POPULATION.format(""))
    assert (
        "give `k` a value (`const`) or a prior; or give the median of `a` a prior (`prior` before `per`)"
        in warning.help
    )
    assert not warnings(POPULATION.format(" prior normal(1, 0.1)"))
