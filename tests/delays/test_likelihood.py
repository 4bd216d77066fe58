"""`evaluate` with delays: the predictions and the gradient are those of the exact solution."""

from __future__ import annotations

from pathlib import Path

import pytest

import gbspec

TEXT = """model delayed
time t from 0
state x
learn k = 0.5 in [0, 2]
x' = -k*delay(x, 1)
initial x = 1
observe x noise normal(0.1)
"""


def test_the_likelihood_of_a_model_with_a_delay_is_that_of_the_exact_solution(tmp_path: Path) -> None:
    (tmp_path / "model.gb").write_text(TEXT)
    (tmp_path / "data.csv").write_text("t,x\n0.5,0.7\n1.5,0.4\n")
    found = gbspec.evaluate(tmp_path / "model.gb", tmp_path / "data.csv")
    # by the method of steps: 1 - kt, then 1 - kt + k^2 (t - 1)^2 / 2
    expected = [1 - 0.5 * 0.5, 1 - 0.5 * 1.5 + 0.25 * 0.25 / 2]
    assert [one.value for one in found.found.simulation] == pytest.approx(expected, rel=1e-7)
    slope = 100 * ((expected[0] - 0.7) * -0.5 + (expected[1] - 0.4) * (-1.5 + 0.5 * 0.25))
    assert found.gradient["k"] == pytest.approx(slope, rel=1e-6)
