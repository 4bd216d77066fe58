"""Errors of channels with log-normal noise: of logarithms everywhere, as the fit has them, and named so."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.analysis.prediction.forecast import Errors, forecast
from gbspec.analysis.validation.metrics import channel_errors
from gbspec.analysis.validation.step_check import StepCheck
from gbspec.analysis.validation.validate import Validation, WorstRow, validate
from gbspec.data import Trajectories
from gbspec.ir import ErrorScale
from gbspec.report.html.tables import metrics
from gbspec.report.verdict import verdict
from gbspec.runs.store import Run
from gbspec.training import TrainOptions, train
from tests.training.conftest import model_of, trajectory

DECAY = "model decay\ntime t from 0\nstate x in [0, 1000]\nlearn k = 0.5 in [0.05, 5]\nx' = -k*x\ninitial x = 900\n"


def decays(count: int, seed: int) -> Trajectories:
    """Exponential decays over three decades, with a noise of 40 %."""
    random, times = np.random.default_rng(seed), np.linspace(0.2, 8, 14)
    values = [900 * np.exp(-0.8 * times + 0.4 * random.standard_normal(14)) for _ in range(count)]
    items = [trajectory(f"{seed}-{i}", 0.0, times, one[:, None], []) for i, one in enumerate(values)]
    return Trajectories(tuple(items), ("x",))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory, quick_fits: None) -> tuple[Run, Trajectories]:
    data = decays(2, 0)
    model = model_of(DECAY + "observe x noise lognormal(0.4)\n")
    return train(model, data, TrainOptions(), tmp_path_factory.mktemp("decay") / "run"), data


@pytest.fixture(scope="module")
def found(fitted: tuple[Run, Trajectories]) -> Validation:
    return validate(*fitted)


def test_validate_and_the_report_have_the_figure_of_the_fit(
    fitted: tuple[Run, Trajectories], found: Validation
) -> None:
    known = (fitted[0].fit.members[0].channels or {})["x"]
    assert found.channels["x"].r2 == pytest.approx(known.r2, abs=1e-6)
    assert found.trajectories[0].nrmse == pytest.approx(np.sqrt(1 - found.channels["x"].r2), rel=0.5)
    assert "nrmse and r2 of `x`: of logarithms, as the noise is" in str(found)
    assert "of the logarithms of x" in found.summary()
    said = verdict(fitted[0], found, (), with_data=True)
    assert any("R² 0.9" in text and "of logarithms, as the noise is" in text for text in said.good)
    assert metrics(found.to_json())["on the data"].rows[0][-1] == "logarithms"


def test_the_worst_row_is_the_worst_of_logarithms(fitted: tuple[Run, Trajectories], found: Validation) -> None:
    worst, values = found.worst, np.concatenate([item.values[:, 0] for item in fitted[1].items])
    assert worst is not None
    assert worst.deviations == pytest.approx(abs(np.log(worst.predicted / worst.measured)) / np.log(values).std())
    ratio = max(worst.predicted / worst.measured, worst.measured / worst.predicted)
    assert (fitted[0].fit.noise["x"] or 0.0) < np.log1p(0.4**2) ** 0.5
    assert worst.of_noise == pytest.approx(np.log(ratio) / np.log1p(0.4**2) ** 0.5)
    assert f"{worst.of_noise:.2g} standard deviations of the stated noise" in str(worst)


@pytest.mark.parametrize(
    ("measured", "predicted", "logarithms", "of_noise", "said"),
    [
        (28.21, 33.02, True, None, "measured 28.21 mg/L, predicted 33.02 mg/L: 17 % apart"),
        (1.0, 3.5, True, 5.0, "predicted 3.5 mg/L: a factor of 3.5 apart, 5 standard deviations of the noise"),
        (3.5, 1.0, True, 5.0, "predicted 1 mg/L: a factor of 3.5 apart, 5 standard deviations of the noise"),
        (3.5, -1.0, True, 5.0, "predicted -1 mg/L: 4.5 mg/L apart, 5 standard deviations of the noise"),
        (0.94, 0.959, False, 2.3, "predicted 0.959 mg/L: 0.019 mg/L apart, 2.3 standard deviations of the noise"),
        (0.94, 0.959, False, None, "predicted 0.959 mg/L: 0.019 mg/L apart"),
    ],
)
def test_the_distance_of_the_worst_row_is_in_terms_of_the_measurement(
    measured: float, predicted: float, logarithms: bool, of_noise: float | None, said: str
) -> None:
    worst = WorstRow("a", 1.0, "x", measured, predicted, 0.11, logarithms, of_noise, "mg/L")
    assert str(worst).endswith(said)


def test_errors_of_predictions_are_of_logarithms(fitted: tuple[Run, Trajectories]) -> None:
    made = forecast(fitted[0], decays(2, 1))
    rows = [np.array(item.used) == "predicted" for item in made.items]
    measured, mean = (
        np.log(np.concatenate([getattr(item, which)[row, 0] for item, row in zip(made.items, rows, strict=True)]))
        for which in ("measured", "mean")
    )
    one = made.errors()["x"]
    assert one.nrmse == pytest.approx(np.sqrt(np.mean((measured - mean) ** 2)) / measured.std())
    assert one.to_json()["logarithms"] is True
    assert one.rmse_of_logarithms == pytest.approx(np.sqrt(np.mean((measured - mean) ** 2)))
    assert one.to_json()["rmse_of_logarithms"] == one.rmse_of_logarithms
    assert f"; of logarithms {one.rmse_of_logarithms:.3g} (a typical " in str(made)


@pytest.mark.parametrize(
    ("size", "said"),
    [
        (0.061, "rmse 14.2; of logarithms 0.061 (a typical error of 6.1 %), 90 % inside"),
        (0.8, "rmse 14.2; of logarithms 0.8 (a typical factor of 2.2), 90 % inside"),
    ],
)
def test_errors_of_logarithms_are_told_as_relative_errors(size: float, said: str) -> None:
    assert said in str(Errors(40, 14.2, 0.0461, 0.9, True, size))
    assert "rmse 14.2, 0.0461 of their standard deviation, 90 % inside" in str(Errors(40, 14.2, 0.0461, 0.9))
    assert "rmse 14.2, 90 % inside" in str(Errors(1, 14.2, float("nan"), 0.9))


def test_only_errors_of_logarithms_are_marked() -> None:
    measured, predicted = np.array([1.0, 10.0, 100.0, 0.0]), np.array([2.0, 10.0, 100.0, 1.0])
    plain, logs = channel_errors(measured, predicted), channel_errors(measured, predicted, ErrorScale(logarithms=True))
    assert "logarithms" not in plain.to_json()
    assert logs.to_json()["logarithms"] is True
    assert (plain.n, logs.n) == (4, 3), "a measured zero has no logarithm"
    assert logs.rmse == pytest.approx(np.sqrt(1 / 3)), "in the channel's unit"
    assert logs.nrmse == pytest.approx(np.sqrt(np.log(2) ** 2 / 3) / np.std(np.log([1, 10, 100])))
    assert logs.r2 == pytest.approx(1 - logs.nrmse**2)
    assert "of logarithms" not in str(Validation("mean", {"x": plain}, (), StepCheck(None, None)))
    assert channel_errors(np.ones(3), np.full(3, np.e), ErrorScale(logarithms=True)).nrmse == pytest.approx(1)
