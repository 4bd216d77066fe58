"""Constants that the data do not hold must not come to rest where the solver's steps are just stable."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import gbspec

pytestmark = pytest.mark.usefixtures("quick_fits")

GROWTH = """\
model growth "Growth until the nitrogen is used up; its half-saturation shows in few rows"
time t : h
state X in [0, 10]
state N in [0, 20]
learn mu in [0.01, 5]
learn K in [0.001, 10]
X' = mu*X*N/(K + N)
N' = -2*mu*X*N/(K + N)
initial N = 10
observe X
"""


def table() -> dict[str, np.ndarray]:
    t = np.arange(0.0, 30.0, 2.0)

    def rates(_: float, x: np.ndarray) -> list[float]:
        growth = 0.3 * x[0] * x[1] / (0.03 + x[1])
        return [growth, -2 * growth]

    x = solve_ivp(rates, (0, 30), [0.1, 10.0], t_eval=t, method="LSODA", rtol=1e-10, atol=1e-12).y[0]
    return {"t": t, "X": x + 0.05 * np.random.default_rng(4).normal(size=len(t))}


def test_a_constant_may_cross_the_limit_of_the_first_step(tmp_path: Path) -> None:
    (tmp_path / "growth.gb").write_text(GROWTH)
    fit = gbspec.load(tmp_path / "growth.gb").train(table(), tmp_path / "run").run.fit
    low, high = fit.constants["K"].interval or (0.0, 0.0)
    remarks = [stage.remark or "" for stage in fit.members[0].stages]
    assert any("near the limit of stability" in text for text in remarks)
    assert fit.constants["K"].value < 0.1 and low < 0.03 < high  # 0.16, where the first steps are just stable
