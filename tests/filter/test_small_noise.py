"""A learned noise that is smaller than the rounding of the measurements is told."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.training.runs.small_noise import step_of

DRIFT = """\
model drift
time t : h from 0
state x in [0, 10]
learn k : 1/h = 0.1 in [0.001, 1]
learn s = 0.1 > 0
initial x = 1.001
x' = k*x
diffusion x = s
observe x
"""


@pytest.mark.parametrize(
    ("values", "step"),
    [([0.01, 0.011, 0.12], 0.001), ([53.8, 53.6, 54.0], 0.1), ([120.0, 30.0, 0.0], 10.0), ([0.0, 0.0], 0.0)],
)
def test_the_step_of_a_table_is_its_finest_decimal(values: list[float], step: float) -> None:
    assert step_of(np.array(values * 5)) == pytest.approx(step)
    assert step_of(np.array(values)) == 0, "too few to tell"


def test_a_noise_below_rounding_is_told(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    x = [1.0]
    for _ in range(40):
        x.append(x[-1] * np.exp(0.02) + 0.05 * random.standard_normal())
    (tmp_path / "m.gb").write_text(DRIFT)
    (tmp_path / "d.csv").write_text("t,x\n" + "".join(f"{t},{value:.2f}\n" for t, value in enumerate(x)))
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run", effort="low").run.fit
    small = fit.noise["x"] is not None and fit.noise["x"] < 0.5 * 0.01 / 12**0.5
    said = [text for text in fit.warnings if "noise of `x`" in text]
    assert small and len(said) == 1, (fit.noise, fit.warnings)
    assert "rounding of its values to multiples of 0.01" in said[0] and "noise normal(…)" in said[0]
    (tmp_path / "m.gb").write_text(DRIFT.rstrip() + " noise normal(0.003)\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "stated", effort="low").run.fit
    assert not [text for text in fit.warnings if "noise of `x`" in text]
