"""`train --set`: the run stores the values it was computed with."""

from __future__ import annotations

from pathlib import Path

import pytest

import gbspec
from gbspec import frontend
from gbspec.diagnostics import Findings
from gbspec.operations import models

TEXT = """\
model m
state x in [0, 2] = 1
const Q = 1
learn k = 1 in [0, 10]
x' = -k*Q*x
initial x = 1
observe x
truth k = 3
"""


@pytest.mark.usefixtures("quick_fit")
def test_a_run_keeps_the_values_that_were_set(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(TEXT)
    (tmp_path / "d.csv").write_text("t,x\n0.5,0.05\n1,0.002\n")
    values = {"Q": 2.0, "k": 30.0}
    made = gbspec.load(tmp_path / "m.gb").train(
        tmp_path / "d.csv", tmp_path / "run", values=values, effort="low", method="lm", epochs=1
    )
    text = (tmp_path / "run" / "model.gb").read_text()
    assert "const Q = 2.0" in text
    assert "learn k = 30.0 in [0, 30.0]" in text
    kept = gbspec.open_run(tmp_path / "run").run.model
    assert [constant.value for constant in kept.constants] == [2.0]
    assert [truth.value for truth in kept.truth_constants] == [3.0], "a start is not the truth"
    assert made.run.model.text == kept.text


def test_without_set_the_model_is_unchanged(tmp_path: Path) -> None:
    (tmp_path / "m.gb").write_text(TEXT)
    model = frontend.load_model(tmp_path / "m.gb", Findings())
    assert models.specified(model, {}) is model
