"""evaluate: the negative log likelihood at a point, against closed forms."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gbspec as package

pytestmark = pytest.mark.usefixtures("quick_fits")

Run = Callable[..., Any]

CONVERSION = """\
model conversion
learn k1 = 0.8 in [0, 10]
learn k2 = 0.6 in [0, 10]
learn s = 0.5 in [0.01, 10]
state A
state B
process there: A -> B rate k1*A
process back: B -> A rate k2*B
initial A = 1
initial B = 0
observe yA = A noise normal(s)
observe yB = B noise lognormal(0.3)
observe total = A + 2*B
"""

TABLE = "trajectory,t,yA,yB,total,sd_total\na,0,0.7,,,\na,2,,0.4,1.2,0.1\nb,0,,,,\nb,10,0.1,0.5,1.7,0.2\n"


def closed(k1: float, k2: float, s: float) -> float:
    """The negative log likelihood of TABLE."""

    def b(t: float) -> float:
        return k1 / (k1 + k2) * (1 - math.exp(-(k1 + k2) * t))

    def term(residual: float, sd: float) -> float:
        return 0.5 * math.log(2 * math.pi * sd**2) + 0.5 * (residual / sd) ** 2

    log_sd = math.sqrt(math.log1p(0.3**2))
    found = term(1 - 0.7, s) + term(1 - b(10) - 0.1, s) + term(1 + b(2) - 1.2, 0.1) + term(1 + b(10) - 1.7, 0.2)
    return found + sum(term(math.log(b(t) / y), log_sd) + math.log(y) for t, y in ((2.0, 0.4), (10.0, 0.5)))


@pytest.fixture
def place(here: Path) -> Path:
    (here / "conversion.gb").write_text(CONVERSION)
    (here / "data.csv").write_text(TABLE)
    return here


def test_the_likelihood_and_its_gradient_are_those_of_the_closed_form(place: Path, document: Run) -> None:
    made = document("evaluate", "conversion.gb", "data.csv", "--set", "k1=0.9")
    assert made["nllh"] == pytest.approx(closed(0.9, 0.6, 0.5), rel=1e-8)
    h = 1e-5
    for i, name in enumerate(("k1", "k2", "s")):
        up, down = ([0.9, 0.6, 0.5] for _ in range(2))
        up[i], down[i] = up[i] + h, down[i] - h
        assert made["gradient"][name] == pytest.approx((closed(*up) - closed(*down)) / (2 * h), rel=1e-6)
    assert made["accuracy"] < 1e-6
    assert [(one["trajectory"], one["t"], one["channel"]) for one in made["simulation"]][:3] == [
        ("a", 0.0, "yA"),
        ("a", 2.0, "yB"),
        ("a", 2.0, "total"),
    ]
    assert made["chi2"] == pytest.approx(sum(one["residual"] ** 2 for one in made["simulation"]))
    assert made["simulation"][2]["sd"] == 0.1


def test_from_python_a_result_is_a_frame(place: Path) -> None:
    found = package.evaluate("conversion.gb", "data.csv", values={"k1": 0.9})
    assert found.nllh == pytest.approx(closed(0.9, 0.6, 0.5), rel=1e-8)
    columns = ["trajectory", "t", "channel", "value", "measured", "sd", "residual", "limit"]
    assert found.to_frame().columns == columns
    assert "d nllh/d k1" in str(found)


def test_a_condition_without_a_value_in_the_table_is_set(here: Path, document: Run) -> None:
    (here / "fall.gb").write_text(
        "model fall\ncondition a = 1\ncondition b = 1\nlearn k = 0.5 in [0.01, 5]\nstate x\ninitial x = a\n"
        "x' = -k*b*x\nobserve x noise normal(0.1)\n"
    )
    (here / "d.csv").write_text("trajectory,t,a,x\none,0,2,\none,1,,0.9\ntwo,0,,\ntwo,1,,0.9\n")
    made = document("evaluate", "fall.gb", "d.csv", "--set", "a=3", "--set", "b=2")
    expected = [2 * math.exp(-1), 3 * math.exp(-1)]
    assert [one["value"] for one in made["simulation"]] == pytest.approx(expected, rel=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("bound", "inside"), [(0.0, 1e-4), (1.0, 1 - 1e-4)])
def test_a_constant_at_its_bound_has_a_derivative(here: Path, document: Run, bound: float, inside: float) -> None:
    (here / "level.gb").write_text(
        "model level\nstate X in [-9, 9]\nlearn c = 0.5 in [0, 1]\nlearn s = 0.5 in [0.1, 3]\nX' = c - X\n"
        "diffusion X = s\ninitial X = 1\nobserve X noise normal(0.1)\n"
    )
    (here / "data.csv").write_text("t,X\n0,\n1,0.9\n2,0.3\n3,0.8\n4,0.7\n")
    there, near = (document("evaluate", "level.gb", "data.csv", "--set", f"c={c}") for c in (bound, inside))
    slope = (near["nllh"] - there["nllh"]) / (inside - bound)
    assert there["gradient"]["c"] == pytest.approx(slope, rel=1e-2)


def test_a_stiff_model_is_solved_by_a_stiff_method(here: Path, document: Run) -> None:
    (here / "stiff.gb").write_text(
        "model stiff\nlearn k = 1e7 in [1, 1e9]\nstate X\nX' = -k*(X - cos(t))\ninitial X = 0\n"
        "observe X noise normal(0.1)\n"
    )
    (here / "data.csv").write_text("t,X\n0,\n0.5,0.9\n5,0.3\n")
    made = document("evaluate", "stiff.gb", "data.csv")
    assert made["solver"] == "ros34pw2"
    assert [one["value"] for one in made["simulation"]] == pytest.approx([math.cos(0.5), math.cos(5.0)], abs=1e-6)


def test_a_run_is_evaluated_from_the_starts_that_it_has_learned(here: Path, gbspec: Run, document: Run) -> None:
    """Whole solutions of noisy values begin where the fit has them begin, not at the first values. At a maximum the
    gradient is small, which says nothing against the integration."""
    (here / "m.gb").write_text(
        "model m\nlearn k = 0.5 in [0.01, 5]\nstate x in [0, 3]\nx' = -k*x\nobserve x noise normal(0.1)\n"
    )
    random = np.random.default_rng(0)
    times = np.arange(0.0, 3.0, 0.5)
    rows = [(i, t, 2 * np.exp(-0.7 * t) + 0.1 * random.standard_normal()) for i in range(3) for t in times]
    (here / "d.csv").write_text("trajectory,t,x\n" + "".join(f"{i},{t},{x:.4f}\n" for i, t, x in rows))
    assert gbspec("train", "m.gb", "d.csv", "-o", "run").exit_code == 0
    result = gbspec("evaluate", "run", "d.csv", "--json")
    made, run = json.loads(result.stdout), package.open_run("run")
    starts = run.learned_starts()["x"].to_list()
    left = [(starts[i] * np.exp(-run.constants["k"] * t) - x) / 0.1 for i, t, x in rows]
    assert made["chi2"] == pytest.approx(np.sum(np.square(left)), rel=1e-3)
    assert any(abs(first - rows[6 * i][2]) > 0.02 for i, first in enumerate(starts))
    assert abs(made["gradient"]["k"]) < 1.0 and "GB889" not in result.stderr


def test_a_run_is_evaluated_with_its_networks_starts_and_noise(
    here: Path, decay: Path, gbspec: Run, document: Run
) -> None:
    assert gbspec("simulate", decay, "-o", "d.csv", "--trajectories", 3, "--span", 2, "--noise", 0.02,
                  "--keep-start").exit_code == 0  # fmt: skip
    assert gbspec("train", decay, "d.csv", "-o", "run", "--effort", "low", "--workers", 1).exit_code == 0
    made = document("evaluate", "run", "d.csv")
    assert made["gradient"] == {}
    assert len(made["simulation"]) == 15
    assert max(abs(one["value"] - one["measured"]) for one in made["simulation"]) < 0.2
    assert np.isfinite(made["nllh"])
    found = package.open_run("run").evaluate()
    assert found.nllh == pytest.approx(made["nllh"], rel=1e-9)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("state X = 1\nX' = -k*X\nobserve X\n", "GB886"),
        ("state X = 1\nstate Y\nX' = -k*X + Y\nY' = -Y\nobserve X noise normal(1)\n", "GB887"),
    ],
)
def test_what_cannot_be_evaluated_is_said(here: Path, gbspec: Run, text: str, code: str) -> None:
    (here / "m.gb").write_text("model m\nlearn k = 1 in [0, 5]\n" + text)
    (here / "d.csv").write_text("t,X\n0,1\n1,0.4\n")
    result = gbspec("evaluate", "m.gb", "d.csv")
    assert result.exit_code == 1
    assert code in result.stderr


JUMP = """\
model jump
learn k = 0.7 in [0.05, 5]
learn a = 1.8 in [0.3, 5]
learn tau = 1.3 in [0.3, 5]
state x in [0, 10]
x' = if(t < tau, 0.5, 1) - k*if(x > a, 1, 2)*x
initial x = 3
observe x noise normal(0.05)
"""
FALL = "t,x\n0.2,2.75\n0.5,2.32\n0.8,1.9\n1.1,1.5\n1.6,1.1\n2.4,0.9\n"


@pytest.mark.parametrize("place", ["k", "a", "tau"])
def test_the_gradient_knows_how_the_times_of_jumps_move(here: Path, place: str) -> None:
    """Also by constants that occur in comparisons alone."""
    (here / "jump.gb").write_text(JUMP)
    (here / "data.csv").write_text(FALL)
    at = {"k": 0.7, "a": 1.8, "tau": 1.3}
    model, data = package.load("jump.gb"), "data.csv"
    near = [model.evaluate(data, values={**at, place: at[place] + step}).nllh for step in (1e-4, -1e-4)]
    slope = model.evaluate(data, values=at).gradient[place]
    assert abs(slope) > 1 and slope == pytest.approx((near[0] - near[1]) / 2e-4, rel=1e-4)


def test_derivatives_that_are_not_known_are_not_given(here: Path, gbspec: Run, document: Run) -> None:
    """With delays steps do not end at jumps."""
    late = JUMP.replace("*x\n", "*x + 0.01*delay(x, 0.5)\nhistory x = 3\nlearn c = 1 in [0.5, 2]\n")
    late = late.replace("observe x", "observe y = c*x")
    (here / "jump.gb").write_text(late)
    (here / "data.csv").write_text(FALL.replace("x", "y"))
    gradient = document("evaluate", "jump.gb", "data.csv")["gradient"]
    assert [gradient[name] for name in ("k", "a", "tau")] == [None, None, None]
    assert isinstance(gradient["c"], float)
    said = gbspec("evaluate", "jump.gb", "data.csv")
    assert "GB893" in said.stderr and "the model has delays" in said.stderr
    assert "d nllh/d k is not known" in said.stdout


NEVER = JUMP.replace("if(t < tau, 0.5, 1) - k*if(x > a, 1, 2)*x", "0.1*tau - k*if(x > 0, x/(a + x), 0)")
LATE = NEVER.replace("a + x), 0)", "a + x), 0) + 0.01*delay(x, 0.5)\nhistory x = 3")
BESIDE = JUMP.replace("*x\n", "*x + 0.1*max(x, mod(t, 2))\n")


@pytest.mark.parametrize("text", [NEVER, LATE, BESIDE], ids=["a kink", "a kink beside a delay", "a kink beside a jump"])
def test_derivatives_at_kinks_are_known(here: Path, gbspec: Run, text: str) -> None:
    """Where branches agree there is no jump; and steps end at a jump whatever else has a kink."""
    (here / "kink.gb").write_text(text)
    (here / "data.csv").write_text(FALL)
    model, data, at = package.load("kink.gb"), "data.csv", {"k": 0.7, "a": 1.8, "tau": 1.3}
    gradient = model.evaluate(data, values=at).gradient
    for place, known in gradient.items():
        near = [model.evaluate(data, values={**at, place: at[place] + step}).nllh for step in (1e-4, -1e-4)]
        assert known == pytest.approx((near[0] - near[1]) / 2e-4, rel=1e-3)
    assert "GB893" not in gbspec("evaluate", "kink.gb", "data.csv").stderr
