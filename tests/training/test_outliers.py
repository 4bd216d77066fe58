"""Few values far from all others: the summary counts them, and says what to write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.runs import ChannelRecord
from gbspec.training.runs.outlying import Outlying, Place, said_of_outlying
from tests.training.conftest import model_of

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = "model decay\nstate x\nlearn k in [0.01, 10]\nx' = -k*x\nobserve x\n"


def table(wrong: float) -> dict[str, np.ndarray]:
    t = np.linspace(0, 4, 60)
    x = np.exp(-0.7 * t) + 0.01 * np.random.default_rng(2).normal(size=60)
    x[[20, 41]] += wrong
    return {"t": t, "x": x}


@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_outliers_are_counted(tmp_path: Path, wrong: float) -> None:
    (tmp_path / "decay.gb").write_text(DECAY)
    fit = gbspec.load(tmp_path / "decay.gb").train(table(wrong), tmp_path / "run", effort="low").run.fit
    said = [text for text in fit.warnings if "far from all others" in text]
    assert len(said) == (wrong > 0)
    assert all("2 of 60 residuals of `x` are far from all others (t = 1.35593, 2.77966): they" in text for text in said)
    assert all("leave these cells empty, or write `observe x" in text for text in said)
    assert (fit.members[0].channels or {})["x"].outliers == (2 if wrong else None)


def test_what_is_offered_can_be_fitted(tmp_path: Path) -> None:
    (tmp_path / "decay.gb").write_text(
        DECAY.replace("observe x", "learn s_x = 0.02 > 0\nobserve x noise student(s_x, 4)")
    )
    fit = gbspec.load(tmp_path / "decay.gb").train(table(0.4), tmp_path / "run", effort="low").run.fit
    assert fit.constants["k"].value == pytest.approx(0.7, rel=0.02)
    assert not any("far from all others" in text for text in fit.warnings)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("x' = -k*x", "learn c = 1 per trajectory\nx' = -k*x - c"),
        ("x' = -k*x", "x' = -k*x\ndiffusion x = 0.1"),
        ("observe x", "observe x noise lognormal(0.1)"),
        ("", ""),
    ],
)
def test_a_noise_that_cannot_be_fitted_is_not_offered(before: str, after: str) -> None:
    """Student's noise is part of a marginal likelihood: it takes no constants of single trajectories that have no
    distribution."""
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nobserve x\n".replace(before, after))
    channels = {"x": ChannelRecord(0.9, 0.0, values=200)}
    (said,) = said_of_outlying(channels, {"x": Outlying((Place("a", 3.0, 3.0, 1),))}, model, {"x": 0.1})
    assert "leave this cell empty" in said and ("student" in said) is (before == "")


@pytest.mark.parametrize(
    ("state", "first", "offered"),
    [
        ("state x = 1", True, True),
        ("state x = 1\ninitial x learn", True, False),
        ("state x = 1\nstate y in [0, 2]\ny' = -k*y", True, False),
        ("state x = 1", False, False),
        ("state x = 1\ninitial x = 1", False, True),
    ],
)
def test_student_noise_is_offered_where_all_starts_are_known(
    tmp_path: Path, state: str, first: bool, offered: bool
) -> None:
    """Its likelihood learns no start of its own for each trajectory."""
    (tmp_path / "m.gb").write_text(f"model m\ntime t\n{state}\nlearn k = 0.5 in [0.01, 3]\nx' = -k*x\nobserve x\n")
    t = np.linspace(0, 4, 40)
    x = np.exp(-0.4 * t) + 0.01 * np.random.default_rng(1).normal(size=40)
    x[20] += 0.5
    x[0] = x[0] if first else np.nan
    fit = gbspec.load(tmp_path / "m.gb").train({"t": t, "x": x}, tmp_path / "run", effort="low").run.fit
    (said,) = [text for text in fit.warnings if "far from all others" in text]
    assert ("noise student(s_x, 4)" in said) is offered


def test_large_residuals_in_successive_rows_are_no_outliers(tmp_path: Path) -> None:
    (tmp_path / "decay.gb").write_text(DECAY)
    data = table(0.0)
    data["x"][40:43] += 0.4  # something acts there that the model does not have
    fit = gbspec.load(tmp_path / "decay.gb").train(data, tmp_path / "run", effort="low").run.fit
    (said,) = [text for text in fit.warnings if "far from all others" in text]
    assert "3 of 60 residuals of `x` are far from all others (t = 2.71186 to 2.84746), in rows that follow" in said
    assert "outlier" not in said and "empty" not in said and "student" not in said


CELL = """model cell
input I held
state u = 0
learn R in [0.01, 10]
learn k in [0.01, 10]
u' = I - k*u
let drop = R*I
observe V = u + drop noise normal(0.01)
"""


def pulses(measured: str) -> dict[str, np.ndarray]:
    """Two pulses of a current, with the voltage at each switch from `before` or `after` it."""
    t, current = np.arange(80.0), np.zeros(80)
    current[20:40], current[60:70] = 1.0, 2.0
    u = np.zeros(80)
    for i in range(79):
        u[i + 1] = current[i] / 0.3 + (u[i] - current[i] / 0.3) * np.exp(-0.3)
    felt = current if measured == "after" else np.concatenate([[0.0], current[:-1]])
    return {"t": t, "I": current, "V": u + 0.7 * felt + 0.01 * np.random.default_rng(1).normal(size=80)}


@pytest.mark.parametrize("measured", ["before", "after"])
def test_values_from_before_a_switch_are_told(tmp_path: Path, measured: str) -> None:
    (tmp_path / "cell.gb").write_text(CELL)
    fit = gbspec.load(tmp_path / "cell.gb").train(pulses(measured), tmp_path / "run", effort="low").run.fit
    said = [text for text in fit.warnings if "far from all others" in text]
    assert len(said) == (measured == "before")
    for text in said:
        assert "4 of 80 residuals of `V` are far from all others (t = 20, 40, 60, 70)" in text
        assert "the input `I`, which the expression of `V` contains, changes in these rows" in text
        assert "outlier" not in text and "student" not in text


def test_an_input_that_changes_in_every_row_explains_no_large_residuals(tmp_path: Path) -> None:
    (tmp_path / "cell.gb").write_text(CELL)
    data = pulses("after")
    rng = np.random.default_rng(3)
    data["I"] = data["I"] + 0.001 * rng.normal(size=80)
    data["V"][[15, 50]] += 0.5
    fit = gbspec.load(tmp_path / "cell.gb").train(data, tmp_path / "run", effort="low").run.fit
    (said,) = [text for text in fit.warnings if "far from all others" in text]
    assert "2 of 80" in said and "the input" not in said and "leave these cells empty" in said


def test_one_outlier_is_no_several_and_places_have_their_trajectories() -> None:
    model = model_of("model m\nstate x = 1\nlearn k = 1\nx' = -k*x\nobserve x\n")

    def said(*places: Place) -> str:
        channels = {"x": ChannelRecord(0.9, 0.0, values=200)}
        found = Outlying(places, several=len(places) != 1 or places[0].trajectory != "alone")
        return said_of_outlying(channels, {"x": found}, model, {"x": 0.1})[0]

    one = said(Place("alone", 3.0, 3.0, 1))
    assert "1 of 200 residuals of `x` is far from all others (t = 3): it is" in one and "leave this cell empty" in one
    assert "others (t = 3 of trajectory `b`): it is" in said(Place("b", 3.0, 3.0, 1)), "one of several trajectories"
    several = said(*(Place(label, 3.0, 3.0, 1) for label in "abcdef"))
    assert "3 of trajectory `a`, 3 of trajectory `b`" in several and "`d` and 2 more)" in several
