"""Residuals are compared with the standard deviations that the table gives (columns `sd_…`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gbspec.analysis.validation.validate import validate
from gbspec.data import Trajectories
from gbspec.runs import ChannelRecord
from gbspec.training import TrainOptions, train
from gbspec.training.runs.verdict import above_stated, below_stated
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


def below(noise: float, values: int, freedom: float | None, **record: float) -> list[str]:
    model = model_of(DECAY.format(noise=" noise normal(0.2)"))
    found = ChannelRecord(**{"r2": 0.99, "naive": 0.0, "values": values, **record})  # type: ignore[arg-type]
    return below_stated({"x": noise}, model, {"x": found}, freedom)


def test_residuals_far_below_the_stated_noise_are_told_where_chance_does_not_make_them() -> None:
    (text,) = below(0.02, 20, 18)
    assert "`x` are only 0.1 times as large as the noise that the model states, normal(0.2)" in text
    assert text.endswith("predictions have the noise of the residuals, 0.02")
    assert not below(0.12, 2000, 1998), "not by half"
    assert not below(0.08, 6, 4), "by chance"
    assert not below(0.02, 20, None), "not known"
    assert not below(1e-4, 20, 18, r2=1 - 1e-8), "exact data"
    assert not below(0.02, 200, 180, autocorrelation=0.9, pairs=199), "what is left is no noise"


@pytest.mark.parametrize(("noise", "said"), [("normal(0.005)", 0), ("normal(0.1)", 1), ("lognormal(0.3)", 1)])
def test_the_worst_row_has_the_larger_noise(noise: str, said: int, tmp_path: Path) -> None:
    x = np.exp(-TIMES) * (1 + 0.02 * np.random.default_rng(1).standard_normal(len(TIMES)))
    data = Trajectories((trajectory("1", 0.0, TIMES, x[:, None], []),), ("x",))
    run = train(
        model_of(DECAY.format(noise=f" noise {noise}")), data, TrainOptions(workers=1, effort="low"), tmp_path / "run"
    )
    told = [text for text in run.fit.warnings if "times as large as the noise that the model states" in text]
    assert len(told) == said and all("only" in text for text in told)
    worst = validate(run, data).worst
    assert worst is not None and worst.of_noise is not None and worst.stated == bool(said)
    error = abs(worst.predicted - worst.measured)
    if said:
        logarithm = abs(np.log(worst.predicted / worst.measured)) / np.log1p(0.3**2) ** 0.5
        assert worst.of_noise == pytest.approx(logarithm if "log" in noise else error / 0.1)
        assert str(worst).endswith("standard deviations of the stated noise")
    else:
        assert worst.of_noise == pytest.approx(error / max(run.fit.noise["x"] or 0.0, 0.005))
