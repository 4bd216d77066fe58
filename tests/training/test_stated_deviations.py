"""Residuals are compared with the standard deviations that the table gives (columns `sd_…`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.data import Trajectories
from gbspec.training import TrainOptions, train
from gbspec.training.runs.verdict import above_stated
from tests.training.conftest import model_of, trajectory

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = "model m\nstate x\nlearn k = 1 in [0.1, 9]\nx' = -k*x\ninitial x = 1\nobserve x{noise}\n"
ERROR = 0.01
TIMES = np.linspace(0.1, 3.0, 40)


def table(stated: float, logarithmic: bool = False) -> Trajectories:
    """Values with the error `ERROR` (1 + t), of which the table states the part 1/`stated`, in the unit of the values
    (also where the error is a share of them)."""
    x, drawn = np.exp(-TIMES), np.random.default_rng(1).standard_normal(len(TIMES))
    error = ERROR * (1 + TIMES) * (x if logarithmic else 1.0)
    item = trajectory("1", 0.0, TIMES, (x + error * drawn)[:, None], [])
    return Trajectories((replace(item, sd=error[:, None] / stated),), ("x",))


@pytest.mark.parametrize("noise", ["", " noise normal(0.5)", " noise lognormal(0.5)"])
@pytest.mark.parametrize("times", [1.0, 4.0])
def test_residuals_that_are_no_deviations_of_the_table_are_told(noise: str, times: float, tmp_path: Path) -> None:
    """Values with different deviations, against which the number in the model is no measure."""
    data = table(times, logarithmic="log" in noise)
    run = train(model_of(DECAY.format(noise=noise)), data, TrainOptions(workers=1, effort="low"), tmp_path / "run")
    told = [text for text in run.fit.warnings if "times as large as" in text]
    assert len(told) == (times > 1)
    if told:
        assert "the standard deviations that the table states (`sd_x`)" in told[0]
        size = float(told[0].partition("residuals of `x` are ")[2].partition(" times")[0])
        assert size == pytest.approx(times, rel=0.2)  # the root of chi² over the degrees of freedom


def test_noise_of_the_model_is_compared_after_that_of_the_table() -> None:
    model = model_of(DECAY.format(noise=" noise normal(0.2)"))
    (text,) = above_stated({"x": 0.7}, model, {"x": 1.5})
    assert "the model states" in text, "some values have none in the table"
    assert "3.5 times as large as the noise that the model states" in above_stated({"x": 0.7}, model, {})[0]
    assert not above_stated({}, model, {"x": float("nan")})
