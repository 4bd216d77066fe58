"""Predictions of zero or less of channels with log-normal noise, which have neither an interval nor a logarithm."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gbspec.analysis.prediction.below_zero import said_of_ends
from gbspec.analysis.prediction.forecast import Errors, forecast
from gbspec.analysis.prediction.noise import interval
from gbspec.analysis.validation.metrics import ChannelErrors, channel_errors
from gbspec.analysis.validation.step_check import StepCheck
from gbspec.analysis.validation.validate import Validation, validate
from gbspec.arrays import Array
from gbspec.data import Trajectories
from gbspec.ir import ErrorScale
from gbspec.runs.store import Run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

STOCK = (
    "model stock\ntime t from 0\ncondition c in [0, 5]\nstate x in [0, 20]\nlearn k = 0.5 in [0.05, 5]\nx' = -k*c\n"
    "initial x = 10\nobserve y = x/10 noise lognormal(0.1)\n"
)
TIMES = np.linspace(0.5, 8, 16)


def stocks(label: str, c: float) -> Trajectories:
    """A stock that a constant catch `c` makes smaller, as far as it can, measured with a noise of 10 %."""
    noise = np.exp(0.1 * np.random.default_rng(int(10 * c)).standard_normal(16))
    values = np.maximum(10 - 0.8 * c * TIMES, 0.5) / 10 * noise
    return Trajectories((trajectory(label, 0.0, TIMES, values[:, None], [c]),), ("y",))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, quick_fits: None) -> Run:
    run: Path = tmp_path_factory.mktemp("stock") / "run"
    return train(model_of(STOCK), stocks("a", 1.0), TrainOptions(), run)


def test_predict_gives_no_interval_and_leaves_these_rows_out_of_logarithms(fitted: Run) -> None:
    found = forecast(fitted, stocks("b", 2.0))
    (item,) = found.items
    below = item.mean[:, 0] <= 0
    assert 3 < below.sum() < 10
    assert np.array_equal(np.isnan(item.low[:, 0]), below)
    assert np.nanmin(item.low[:, 0]) > 0
    frame = found.to_frame()
    assert frame["y_low"].null_count() == frame["y_high"].null_count() == below.sum()
    new = np.array(item.used) == "predicted"
    one, kept = found.errors()["y"], new & ~below
    logs = np.log(item.measured[kept, 0]) - np.log(item.mean[kept, 0])
    assert (one.n, one.not_positive) == (new.sum(), below.sum())
    assert one.rmse_of_logarithms == pytest.approx(np.sqrt(np.mean(logs**2)))
    assert one.to_json()["not_positive"] == below.sum()
    assert f"without {below.sum()} whose prediction is not positive), " in str(found)
    (said,) = [text for text in found.warnings if "`y`" in text and "zero or less" in text]
    assert said.startswith(
        f"{below.sum()} of 16 predictions of `y` are zero or less (to {item.mean[:, 0].min():.3g}), "
    )
    assert not [text for text in found.warnings if "noise lognormal(" in text]


def test_validate_leaves_them_out_of_logarithms_and_of_the_worst_row(fitted: Run) -> None:
    found = validate(fitted, stocks("b", 2.0))
    one, predicted = found.channels["y"], found.predictions[0].channels[:, 0]
    measured = stocks("b", 2.0).items[0].values[:, 0]
    kept = predicted > 0
    logs = np.log(measured[kept])
    assert (one.n, one.not_positive) == (16, (~kept).sum())
    assert one.r2 == pytest.approx(
        1 - np.sum((np.log(predicted[kept]) - logs) ** 2) / np.sum((logs - logs.mean()) ** 2)
    )
    assert one.rmse == pytest.approx(np.sqrt(np.mean((measured - predicted) ** 2))), "in the unit of the channel"
    assert np.isfinite(found.trajectories[0].nrmse)
    assert found.worst is not None and found.worst.predicted > 0
    (said,) = [text for text in found.warnings if "zero or less" in text]
    assert said.endswith("nrmse, R² and the worst row leave them out")


def test_nothing_is_said_where_all_predictions_are_positive(fitted: Run) -> None:
    assert not [text for text in forecast(fitted, stocks("b", 1.0)).warnings if "zero" in text]
    assert not [text for text in validate(fitted, stocks("b", 1.0)).warnings if "zero" in text]


def test_an_interval_by_a_factor_is_above_zero_or_none() -> None:
    mean, sd = np.array([2.0, 1e-3, -1.0, 0.0, 0.0]), np.array([0.2, 9.0, 0.1, 0.0, 0.1])
    low, high = interval(mean, sd, True)
    assert (low[0], high[0]) == (pytest.approx(2 * np.exp(-0.1645), rel=1e-3), pytest.approx(2.357, rel=1e-3))
    assert np.isnan([*low[[1, 2, 4]], *high[[1, 2, 4]]]).all(), "beyond all numbers, negative, around zero"
    assert (low[3], high[3]) == (0, 0), "a state that is absent"


def test_errors_without_a_single_logarithm() -> None:
    measured = np.array([1.0, 2.0])
    one = channel_errors(measured, -measured, ErrorScale(logarithms=True))
    assert (one.n, one.not_positive) == (2, 2)
    assert one.rmse == pytest.approx(np.sqrt(10))
    assert np.isnan([one.nrmse, one.r2]).all()
    assert "none of logarithms, as no prediction is positive" in str(Errors(2, 3.2, np.nan, 0.0, True, np.nan, 2))


@pytest.mark.parametrize(
    ("mean", "said", "instead"),
    [
        ([-0.05, -0.1, 9.0], "the predictions themselves are negative (to -0.1), since nothing keeps", False),
        ([0.05, -0.1, 9.0], "the predictions themselves are negative in 1 of them (to -0.1), since", False),
        ([0.05, 0.1, 9.0], "they are those of new measurements, with the noise", True),
    ],
)
def test_predictions_that_are_negative_themselves_are_no_ends_of_noise(
    mean: list[float], said: str, instead: bool
) -> None:
    model = model_of("model m\nstate x in [0, 20]\nlearn k = 0.5 in [0.05, 5]\nx' = -k*x\nobserve x\n")
    low: Array = np.array([[-2.0], [-2.0], [7.0]])
    middle = np.array(mean)[:, None]
    (text,) = said_of_ends(model, [SimpleNamespace(failure="", mean=middle, low=low, high=middle)], [])
    assert said in text
    assert ("lognormal" in text) == instead


def test_the_columns_of_validate_do_not_run_together() -> None:
    bad = ChannelErrors(52, 0.08673, 429.4, 0.06693, -184390.0)
    found = Validation("mean", {"cpue": bad}, (), StepCheck(None, None), ahead={"1": {"cpue": bad}})
    rows = [line.split() for line in str(found).split("\n") if line.startswith(("cpue", "1 "))]
    assert rows == [
        ["1", "cpue", "52", "0.08673", "-1.8439e+05"],
        ["cpue", "52", "0.08673", "429.4", "0.06693", "-1.8439e+05"],
    ]


def test_a_start_is_estimated_from_rows_of_which_some_predictions_are_not_positive(
    tmp_path: Path, quick_fits: None
) -> None:
    """Residuals of their continued logarithms are large, and their solutions are solutions nevertheless."""
    text = STOCK.replace("time t from 0\n", "").replace("initial x = 10\n", "")
    noise = np.exp(0.03 * np.random.default_rng(0).standard_normal((16, 1)))
    given = trajectory("a", 0.0, TIMES, (10 - 0.8 * TIMES)[:, None] / 10 * noise, [1.0])
    run = train(model_of(text), Trajectories((given,), ("y",)), TrainOptions(effort="low"), tmp_path / "run")
    times = 0.5 * np.arange(30)
    values = np.maximum(10 - 1.8 * times, 0.3)[:, None] / 10
    rows = Trajectories((trajectory("b", 0.0, times, values, [5.0]),), ("y",))
    (item,) = forecast(run, rows, window=24).items
    assert not item.failure and np.isfinite(item.mean).all()
