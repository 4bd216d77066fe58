"""Predictors that know no model, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.data import Naive, Trajectories, Trajectory, naive_predictors
from gbspec.ir import error_scales
from gbspec.ir.model import Channel, Model, Noise, State, symbol


def model_with(noise: Noise | None = None) -> Model:
    return Model("m", states=(State("x"),), channels=(Channel("x", value=symbol("x"), state=0, noise=noise),))


def series(*values: list[float]) -> Trajectories:
    items = []
    for number, column in enumerate(values):
        table = np.array(column)[:, None]
        times = np.arange(float(len(column)))
        nothing = np.full_like(table, np.nan)
        items.append(Trajectory(str(number), 0.0, times, table, np.ones_like(table), nothing, np.zeros(0)))
    return Trajectories(tuple(items), ("x",))


def found_for(model: Model, data: Trajectories) -> dict[str, Naive]:
    return naive_predictors(model, data, error_scales(model, {}))


def test_a_line_is_predicted_by_a_line() -> None:
    found = found_for(model_with(), series([1.0, 2.0, 3.0, 4.0], [0.0, -1.0, -2.0]))["x"]
    assert found.predictor == "a straight line through each trajectory"
    assert found.r2 == pytest.approx(1.0)


def test_the_error_of_a_mean_is_corrected_for_its_number() -> None:
    values = [1.0, -1.0, 1.0, -1.0, 1.0]
    found = found_for(model_with(), series(values))["x"]
    assert found.predictor == "the mean of each trajectory"
    assert found.r2 == pytest.approx(1 - 5 / 4), "n / (n - 1) times the variance"


def test_two_values_are_not_predicted_by_a_line_through_them() -> None:
    found = found_for(model_with(), series([0.0, 1.0], [0.0, 1.0]))["x"]
    assert found.predictor != "a straight line through each trajectory"


def test_logarithms_are_compared_where_the_noise_is_log_normal() -> None:
    data = series([1.0, 10.0, 100.0, 1000.0])
    assert found_for(model_with(), data)["x"].r2 < 0.8
    assert found_for(model_with(Noise("lognormal", 0.1)), data)["x"].r2 == pytest.approx(1.0)


def test_a_zero_has_no_logarithm_and_is_left_out() -> None:
    data = series([0.0, 10.0, 100.0, 1000.0, 10000.0])
    found = found_for(model_with(Noise("lognormal", 0.1)), data)["x"]
    assert found.r2 == pytest.approx(1.0)


def test_counts_are_compared_on_the_scale_of_their_noise() -> None:
    """The straight line of the roots, not of the counts, whose few large ones outweigh all others; zeros count."""
    data = series([64.0, 49.0, 36.0, 25.0, 16.0, 9.0, 4.0, 1.0, 0.0])
    assert found_for(model_with(), data)["x"].r2 < 0.95
    found = found_for(model_with(Noise("poisson", np.nan)), data)["x"]
    assert (found.predictor, found.r2) == ("a straight line through each trajectory", pytest.approx(1.0))


def test_a_channel_that_does_not_vary_has_none() -> None:
    assert found_for(model_with(), series([2.0, 2.0, 2.0])) == {}
