"""Fits of counts are judged on the scale of their noise: R², naive predictors, residuals, worst rows, predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gbspec.analysis import forecast
from gbspec.analysis.validation.validate import Validation, validate
from gbspec.data import Trajectories
from gbspec.diagnostics import Findings
from gbspec.ir import ErrorScale
from gbspec.operations import tables
from gbspec.report import collect
from gbspec.report.html.tables import metrics
from gbspec.report.text import run_summary
from gbspec.report.verdict import verdict
from gbspec.runs.store import Run
from gbspec.training import TrainOptions, train
from tests.training.test_populations import model_of, table

FALL = """model fall
time t from 0
state x in [0, 2000]
learn x0 = 100 in [1, 1e4] per trajectory ~ lognormal
learn r = 0.5 in [0.01, 5]
learn f = 2 in [0.1, 50]
learn k = 10 in [0.1, 1e4]
x' = -r*(x - f)
initial x = x0
observe x noise negative_binomial(k)
"""
TIMES = np.arange(12.0)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Trajectories]:
    """Counts of size 5 that fall to a level of 50, one of them six times as large: few errors outweigh all others."""
    folder = tmp_path_factory.mktemp("counts")
    random, size = np.random.default_rng(1), 5.0
    starts = np.array([[100.0], [200], [400], [1000], [2000], [2000]])
    mean = 50 + (starts - 50) * np.exp(-0.35 * TIMES)
    values = random.poisson(random.gamma(size, mean / size)).astype(float)
    values[4, 9] *= 6
    table(folder, values, TIMES)
    model = model_of(FALL, folder)
    data = tables.read_data(folder / "data.csv", model, Findings())
    return train(model, data, TrainOptions(max_step=0.5, effort="low"), folder / "run"), data


@pytest.fixture(scope="module")
def found(fitted: tuple[Run, Trajectories]) -> Validation:
    return validate(*fitted, truth=False)


def off(run: Run, data: Trajectories, found: Validation) -> tuple[np.ndarray, np.ndarray]:
    """Counts [trajectory, row] on the scale of their noise, and errors there."""
    scale = ErrorScale(size=run.fit.constants["k"].value)
    values = scale.measured(np.stack([item.values[:, 0] for item in data.items]))
    return values, scale.predicted(np.stack([one.channels[:, 0] for one in found.predictions])) - values


def test_a_right_fit_is_not_condemned_for_the_scatter_of_large_counts(
    fitted: tuple[Run, Trajectories], found: Validation
) -> None:
    run, _ = fitted
    (record,) = [one.channels["x"] for one in run.fit.members if one.channels]
    assert record.r2 is not None and record.naive is not None, "0.554 and 0.579 of the counts themselves"
    assert 1 - record.r2 < 0.9 * (1 - record.naive)
    assert not [one for one in run.fit.warnings if "whole solutions" in one]
    said = verdict(run, found, (), with_data=True)
    assert "Do not rely" not in said.headline
    assert any("of counts on the scale of their noise" in one for one in (*said.good, *said.doubt))


def test_the_fit_and_validate_have_the_same_figure_and_name_its_scale(
    fitted: tuple[Run, Trajectories], found: Validation
) -> None:
    run, data = fitted
    values, errors = off(run, data, found)
    r2 = 1 - np.mean(errors**2) / values.var()
    (record,) = [one.channels["x"] for one in run.fit.members if one.channels]
    assert record.r2 == pytest.approx(r2, abs=1e-4)
    one = found.channels["x"]
    assert (one.r2, one.nrmse) == (pytest.approx(r2), pytest.approx(np.sqrt(1 - r2)))
    assert [item.nrmse for item in found.trajectories] == pytest.approx(
        np.sqrt(np.mean(errors**2, axis=1)) / values.std()
    )
    assert one.to_json()["counts"] is True
    assert "nrmse and r2 of `x`: of counts on the scale of their noise" in str(found)
    assert "R² of `x`: of counts on the scale of their noise" in run_summary(run)
    assert ("x", "counts on the scale of their noise") in [
        (row[0], row[-1]) for part in metrics(found.to_json()).values() for row in part.rows
    ]


def test_residuals_of_counts_are_those_on_the_scale_of_their_noise(
    fitted: tuple[Run, Trajectories], found: Validation
) -> None:
    run, data = fitted
    _, errors = off(run, data, found)
    (record,) = [one.channels["x"] for one in run.fit.members if one.channels]
    first, second = errors[:, :-1], errors[:, 1:]
    expected = np.sum(first * second) / np.sqrt(np.sum(first**2) * np.sum(second**2))
    assert record.autocorrelation == pytest.approx(expected, abs=1e-3)
    (shown,) = collect.residuals(collect.Fitted(run, data))
    assert shown.residual == pytest.approx(errors.ravel(), abs=1e-2)


def test_the_worst_row_is_the_farthest_on_the_scale_of_the_noise(
    fitted: tuple[Run, Trajectories], found: Validation
) -> None:
    run, data = fitted
    _, errors = off(run, data, found)
    i, row = np.unravel_index(np.argmax(np.abs(errors)), errors.shape)
    worst = found.worst
    assert worst is not None
    assert (worst.trajectory, worst.time) == (data.items[i].label, data.items[i].times[row])
    size = run.fit.constants["k"].value
    assert size is not None
    sd = np.sqrt(worst.predicted + worst.predicted**2 / size)
    assert worst.of_noise == pytest.approx(abs(worst.measured - worst.predicted) / sd)


def test_errors_of_predictions_are_on_the_scale_of_the_noise(fitted: tuple[Run, Trajectories]) -> None:
    run, data = fitted
    new = Trajectories(tuple(replace(item, values=item.values + 1.0) for item in data.items), data.channels)
    errors = forecast(run, new, window=2).errors()["x"]
    assert errors.counts and errors.to_json()["counts"] is True
    assert "of their standard deviation on the scale of their noise" in str(errors)
