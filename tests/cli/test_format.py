"""`--format`: commands read tables in the form of NONMEM, and a run remembers the form of its table."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

MODEL = """\
model oral "Absorbed drug"
time t from 0
state gut = 0
state plasma = 0
learn k = 0.4 in [0.05, 3]
dose gut over 0
gut' = -gut
plasma' = gut - k*plasma
initial gut = 0
initial plasma = 0
observe c = plasma/10
"""
TABLE = """\
ID,TIME,AMT,RATE,CMT,DV
1,0,100,50,7,.
1,1,.,.,9,1.6
1,3,.,.,9,4.1
1,6,.,.,9,2.0
1,9,.,.,9,0.7
"""
FORM = "nonmem:7=gut,9=c"


@pytest.fixture
def made(here: Path) -> Path:
    (here / "oral.gb").write_text(MODEL)
    (here / "oral.csv").write_text(TABLE)
    return here


def test_simulate_takes_times_and_doses(gbspec: Callable[..., Any], made: Path) -> None:
    called = ("simulate", "oral.gb", "--like", "oral.csv", "-o", "made.csv")
    assert gbspec(*called, "--format", FORM).exit_code == 0
    rows = (made / "made.csv").read_text().splitlines()
    head = rows[0].split(",")
    assert "infusion_gut" in head and len(rows) == 7  # one row more: the end of the infusion
    refused = gbspec(*called, "--format", "nonmem:7=guts,9=c")
    assert refused.exit_code != 0 and "GB759" in refused.stderr and "`gut`" in refused.stderr


@pytest.mark.usefixtures("quick_fits")
def test_a_run_remembers_the_form(gbspec: Callable[..., Any], document: Callable[..., Any], made: Path) -> None:
    assert gbspec("train", "oral.gb", "oral.csv", "-o", "run", "--effort", "low", "--format", FORM).exit_code == 0
    assert json.loads((made / "run" / "fit.json").read_text())["data"]["format"] == FORM
    assert document("validate", "run")["channels"]["c"]["n"] == 4
