"""Identifiability of models with random disturbances: their starts, and what the disturbances depend on."""

from __future__ import annotations

import pytest

from gbspec.cli.commands.check import examination_summary
from gbspec.diagnostics import Findings
from gbspec.passes import examine
from tests.texts import model_of

LOGISTIC = (
    "model m\ntime t from 0\nstate y in [0, 1]\nlearn mu = 0.5 in [0.01, 3]\nlearn K = 0.15 in [0.02, 0.5]\n"
    "learn y0 = 0.01 in [0.001, 0.05]\nlearn s = 0.003 > 0\ninitial y = y0\ny' = mu*y*(1 - y/K)\nobserve OD = y\n"
)
LAG = LOGISTIC.replace(
    "y' = mu*y", "state q in [0, 100]\nlearn q0 = 0.1 in [0, 1]\ninitial q = q0\nq' = mu*q\ny' = mu*y*q/(1+q)"
)


def told(text: str) -> tuple[list[tuple[str, str | None]], str]:
    """The code and the subject of each warning, and the summary."""
    findings = Findings()
    found = examine(model_of(text), findings)
    return [(d.code, d.subject) for d in findings], examination_summary(found)


@pytest.mark.parametrize("size", ["s", "s*y", "0.01"])
def test_a_learned_start_of_a_measured_state_shows(size: str) -> None:
    text = LOGISTIC + f"diffusion y = {size}\n"
    if "s" not in size:
        text = text.replace("learn s = 0.003 > 0\n", "")
    assert told(text) == ([], "")


def test_a_start_by_another_one_shows() -> None:
    text = LOGISTIC + "state z\nlearn a = 2\ninitial z = a*y\nz' = -z\nobserve z\ndiffusion z = s\n"
    assert told(text) == ([], "")
    alone = text.replace("initial z = a*y", "initial z = a*b*y").replace("learn a = 2\n", "learn a = 2\nlearn b = 3\n")
    assert told(alone)[0] == [("GB401", "a")]


def test_unmeasured_states_leave_the_answer_open_without_a_warning() -> None:
    warnings, summary = told(LAG + "diffusion y = s\n")
    assert warnings == []
    assert "what random disturbances show beside `q`, which is not measured, is not examined" in summary
    assert "without them the learned constants of the equations could be told apart" in summary


def test_unmeasured_states_whose_constants_the_drift_does_not_tell_apart() -> None:
    text = (
        "model m\nstate x\nlearn k = 1\nlearn c = 2\nlearn x0 = 1\ninitial x = x0\nx' = -k*x\nobserve y = c*x\n"
        "diffusion x = 0.1\n"
    )
    warnings, summary = told(text)
    assert warnings == []  # the size of the disturbance may tell the scale of x
    assert "without them `c` and `x0` could not be told apart" in summary


@pytest.mark.parametrize(
    ("size", "names"),
    [("s*r", ["s"]), ("s + r*y", []), ("s*a", ["mu"])],
)
def test_constants_of_disturbances(size: str, names: list[str]) -> None:
    text = LOGISTIC + f"learn r = 1\nlearn a = 1\ndiffusion y = {size}\n"
    text = text.replace("y' = mu*y", "y' = mu*a*y") if "a" in size else text.replace("learn a = 1\n", "")
    text = text if "r" in size else text.replace("learn r = 1\n", "")
    assert [subject for _, subject in told(text)[0]] == names


def test_what_nothing_depends_on_is_still_told() -> None:
    text = LOGISTIC.replace("(1 - y/K)", "(1 - y/K/b)") + "learn b = 1\ndiffusion y = s\n"
    warnings, summary = told(text)
    assert [code for code, _ in warnings] == ["GB401"]
    assert summary == ""
