"""A learned noise that vanishes where the model has a value exactly makes the likelihood infinite: no result."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.training import TrainOptions, train
from tests.training.test_populations import model_of

DOSED = """model dosed
time t from 0
state x in [0, 12]
learn k = 0.5 in [0.01, 5] per trajectory ~ lognormal
learn a = 0.3 > 0
learn b = 0.1 > 0
dose x
x' = -k*x
initial x = 0
observe x noise normal(sqrt(a^2 + (b*y)^2))
"""


def rows(zeros: int) -> list[str]:
    random = np.random.default_rng(5)
    out = ["trajectory,t,x,dose_x"]
    for i in range(8):
        rate = 0.5 * np.exp(0.3 * random.standard_normal())
        out += [f"{i},{0.5 - 0.05 * j:g},0," for j in reversed(range(zeros))]
        out += [f"{i},1,,10"]
        for t in (1.5, 2.0, 3.0, 5.0, 7.0):
            value = 10 * np.exp(-rate * (t - 1))
            out.append(f"{i},{t},{value + np.hypot(0.2, 0.1 * value) * random.standard_normal():.4f},")
    return out


@pytest.mark.parametrize("zeros", [0, 1, 7])
def test_zeros_before_a_dose_with_a_vanishing_noise_are_told(zeros: int, tmp_path: Path) -> None:
    """Also where these are most of the values."""
    (tmp_path / "data.csv").write_text("\n".join(rows(zeros)) + "\n")
    model = model_of(DOSED, tmp_path)
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    fit = train(model, data, TrainOptions(effort="low"), tmp_path / "run").fit
    told = [one for one in fit.warnings if "the likelihood has no maximum" in one]
    assert len(told) == bool(zeros)
    if zeros:
        assert f"{8 * zeros} values of `x`" in told[0] and "`0` at 0." in told[0] and "give `a` a lower" in told[0]
        assert not any("do not need" in one for one in fit.warnings)
    else:
        assert fit.constants["a"].value == pytest.approx(0.2, rel=0.6)
