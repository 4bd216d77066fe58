"""Statements about data in all commands: simulated, trained and validated."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("quick_fits", "few_points")

Run = Callable[..., Any]

DOSED = """\
model dosed "Oral drug with a lag, twice"
time t from 0
state gut = 0
state blood = 0
const V = 10
learn F in [0.2, 1] = 0.5 "fraction absorbed"
learn tlag in [0, 2] = 0.4 "lag, h"
learn ke > 0 prior lognormal(0.25, 0.3)
gut' = -1.2*gut
blood' = 1.2*gut/V - ke*blood
initial gut = 0
initial blood = 0
dose gut times F lag tlag
observe blood noise lognormal(0.05)
truth F = 0.7
truth tlag = 0.85
truth ke = 0.25
"""

NOISY = """\
model noisy "Two channels, each with its own noise"
state A = 1
state B = 0
condition start in [1, 2]
input feed in [0, 1] held
learn k in [0, 5] = 0.3
A' = -k*A + feed
B' = k*A
initial A = 0.5 + start
initial B = 0
observe A noise normal(0.1)
observe B noise lognormal(0.2)
truth k = 0.8
"""


def rows(path: str) -> list[dict[str, str]]:
    with Path(path).open() as file:
        return list(csv.DictReader(file))


def test_doses_are_simulated_learned_and_validated(here: Path, document: Run) -> None:
    Path("dosed.gb").write_text(DOSED)
    sampling = ("--trajectories", 2, "--span", 9, "--dt", 1.1, "--dose", "gut=80:120@0,6")
    made = document("simulate", "dosed.gb", "-o", "t.csv", *sampling)
    assert made["options"]["dose"] == {"gut": "80:120@0,6"}
    given = [row for row in rows("t.csv") if row["dose_gut"]]
    assert [float(row["t"]) for row in given] == [0, 6] * 2
    amounts = {float(row["dose_gut"]) for row in given}
    assert len(amounts) == 4 and all(80 <= amount <= 120 for amount in amounts)
    fit = document("train", "dosed.gb", "t.csv", "-o", "run", "--max-step", 0.4, "--effort", "low")
    for name, value in (("F", 0.7), ("tlag", 0.85), ("ke", 0.25)):
        assert fit["constants"][name]["value"] == pytest.approx(value, rel=0.01), name
    found = document("validate", "run")
    assert found["channels"]["blood"]["nrmse"] < 0.01
    assert found["step_check"]["adaptive"] < 0.01
    again = document("simulate", "run", "-o", "again.csv", "--like", "t.csv", "--dose", "gut=0@0")
    assert again["trajectories"] == 2
    assert all(abs(float(row["blood"])) < 1e-9 for row in rows("again.csv") if row["blood"])


def test_noise_conditional_initial_values_and_sparse_inputs_work_in_all_commands(here: Path, document: Run) -> None:
    Path("noisy.gb").write_text(NOISY)
    document("simulate", "noisy.gb", "-o", "full.csv", "--trajectories", 6, "--span", 4, "--noise", 0.05, "--seed", 2)
    table = rows("full.csv")
    fed = [row for row in table if row["feed"]]
    assert 0 < len(fed) < len(table), "an input stands where it changes, and is missing elsewhere"
    fit = document("train", "noisy.gb", "full.csv", "-o", "run", "--effort", "low")
    assert fit["constants"]["k"]["value"] == pytest.approx(0.8, rel=0.1)
    assert set(fit["noise"]) == {"A", "B"} and all(np.isfinite(sd) and sd > 0 for sd in fit["noise"].values())
    found = document("validate", "run", "full.csv")
    assert all(channel["nrmse"] < 0.2 for channel in found["channels"].values())
    assert found["truth"]["constants"]["k"] < 0.1
