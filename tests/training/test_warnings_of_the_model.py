"""What a run says of its model: what no data can separate, and solutions that leave declared ranges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.training import TrainOptions
from gbspec.training.runs.summary import MemberResult
from gbspec.training.runs.verdict import inseparable
from gbspec.training.runs.warned import warnings_of

pytestmark = pytest.mark.usefixtures("quick_fits")

TEXT = """\
model m
state x in [0, 2]
learn a = 1 in [0, 5]
learn b = 1 in [0, 5]
x' = -a*b*x
initial x = 1
observe x
"""
ONE = TEXT.replace("learn b = 1 in [0, 5]", "const b = 1")


def trained(folder: Path, text: str) -> gbspec.FittedRun:
    (folder / "m.gb").write_text(text)
    rows = "".join(f"{t},{2.718281828 ** (-1.5 * t)}\n" for t in (0, 0.1, 0.2, 0.4, 0.8))
    (folder / "d.csv").write_text("t,x\n" + rows)
    return gbspec.load(folder / "m.gb").train(folder / "d.csv", folder / "run", effort="low")


def test_a_run_says_what_no_data_can_separate(tmp_path: Path) -> None:
    fit = trained(tmp_path, TEXT).run.fit
    (said,) = [one for one in fit.warnings if "GB401" in one]
    assert said.startswith("`a` and `b` cannot be told apart by any data (GB401): ")
    assert "leaves everything that is observed unchanged" in said and "give `a` or `b` a value" in said


def test_a_model_that_allows_it_or_can_be_identified_says_nothing(tmp_path: Path) -> None:
    assert trained(tmp_path, ONE).run.fit.warnings == ()
    (tmp_path / "m.gb").write_text(TEXT + "allow GB401 b\n")
    assert inseparable(gbspec.load(tmp_path / "m.gb").model) == []


@pytest.mark.parametrize(("bounds", "said"), [("[0.8, 1.2]", True), ("[0.29, 1.1]", False), ("[0, 2]", False)])
def test_solutions_far_outside_of_a_declared_range_are_told(tmp_path: Path, bounds: str, said: bool) -> None:
    run = trained(tmp_path, ONE.replace("x in [0, 2]", f"x in {bounds}"))
    told = [one for one in run.run.fit.warnings if "far outside of its range" in one]
    assert bool(told) is said
    if said:
        assert told == [
            "member 0: in the learned solutions, `x`: 3 of 5 values lie far outside of its range [0.8, 1.2]: "
            "from 0.3012 to 0.7408"
        ]


def test_an_unmeasured_state_and_its_start_are_told(tmp_path: Path) -> None:
    text = ONE.replace("state x in [0, 2]\n", "state x\nstate y in [3, 4]\n") + "y' = -y + x\ninitial y = 1\n"
    run = trained(tmp_path, text)
    for warnings in (run.run.fit.warnings, run.validate().warnings):
        told = [one for one in warnings if "far outside" in one]
        assert len(told) == 1 and "`y`: 5 of 5 values" in told[0]


def test_states_far_outside_share_a_sentence_in_the_order_of_the_model(tmp_path: Path) -> None:
    more = "state y in [3, 4]\nstate z in [0, 1]\n"
    text = (
        ONE.replace("state x in [0, 2]\n", f"state x\n{more}") + "y' = -y + x\nz' = 0\ninitial y = 1\ninitial z = 7\n"
    )
    run = trained(tmp_path, text)
    for warnings in (run.run.fit.warnings, run.validate().warnings):
        (told,) = [one for one in warnings if "far outside" in one]
        assert "values of 2 states lie far outside of their ranges: `y` (from " in told
        assert told.endswith(", 5 of 5 values; range [3, 4]), `z` (7, 5 of 5 values; range [0, 1])")


def test_what_concerns_the_whole_fit_is_said_before_single_states_and_constants() -> None:
    member = MemberResult(0, 0.1, 0.1, {}, {}, {}, {}, {}, 1.0, [], np.zeros(0), [])
    one = replace(member, left=["steps"], notes=["minima"], beyond=["ranges"], tied=["constants"], failed=["a"])
    found = warnings_of({0: one, 1: replace(one, failed=[])}, TrainOptions(members=3))
    texts = [text.removeprefix("member 0: ").removeprefix("member 1: ") for text in found]
    assert texts[0] == "1 of 3 members was not fitted" and "blows up" in texts[1]
    assert texts[2:] == ["steps", "minima"] * 2 + ["ranges"] * 2 + ["constants"] * 2
