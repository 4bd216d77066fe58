from __future__ import annotations

import json
import math

import numpy as np
import pytest

from gbspec.analysis.validation.metrics import channel_errors, norms, relative_errors, share_text


def test_norms_are_those_of_the_appendix() -> None:
    truth = np.array([[0.0, 10.0], [2.0, 30.0], [1.0, 20.0]])
    predicted = truth + np.array([[0.2, 0.0], [0.0, 4.0], [-0.2, -2.0]])
    # Scaled by ranges 2 and 20: errors (.1, 0), (0, .2), (.1, .1).
    found = norms(truth, predicted, np.ones(2), ["a", "b"])
    assert pytest.approx((0.1 + 0.2 + 0.2) / 6) == found.L1
    # 1/N_v is outside the root, as printed.
    assert pytest.approx((0.1 + 0.2 + math.sqrt(0.02)) / 6) == found.L2
    assert found.Linf == pytest.approx((0.1 + 0.2 + 0.1) / 3)
    assert (found.points, found.failed, found.fallback) == (3, 0, ())


def test_a_variable_whose_truth_does_not_vary_takes_the_fallback() -> None:
    truth = np.array([[1.0, 0.0], [3.0, 0.0]])
    found = norms(truth, truth + np.array([[0.0, 0.5], [0.0, 0.5]]), np.array([7.0, 5.0]), ["a", "y"])
    assert found.fallback == ("y",)
    assert pytest.approx(0.1 / 2) == found.L1


def test_failed_points_are_counted_and_excluded() -> None:
    truth = np.array([[0.0], [1.0], [2.0]])
    predicted = np.array([[0.0], [np.nan], [2.0]])
    found = norms(truth, predicted, np.ones(1), ["a"])
    assert (found.points, found.failed, found.L2) == (2, 1, 0.0)
    assert "1 of 3 points failed" in str(found)
    none = norms(truth, np.full((3, 1), np.inf), np.ones(1), ["a"])
    assert (none.points, none.failed) == (0, 3)
    assert json.loads(json.dumps(none.to_json()))["L2"] is None


def test_keys_of_norms_come_in_the_order_of_the_contract() -> None:
    assert list(norms(np.eye(2), np.eye(2), np.ones(2), ["a", "b"]).to_json())[:3] == ["L1", "L2", "Linf"]


def test_relative_errors_are_absolute_where_the_truth_is_zero() -> None:
    assert relative_errors({"a": 4.0, "b": 0.0}, {"a": 3.0, "b": 0.25}) == {"a": 0.25, "b": 0.25}


def test_channel_errors_exclude_missing_measurements() -> None:
    measured = np.array([1.0, np.nan, 3.0, 5.0])
    predicted = np.array([1.5, 9.0, 3.0, 4.5])
    found = channel_errors(measured, predicted)
    assert found.n == 3
    assert found.rmse == pytest.approx(math.sqrt(0.5 / 3))
    assert found.mae == pytest.approx(1.0 / 3)
    assert found.r2 == pytest.approx(1.0 - 0.5 / 8.0)
    assert found.nrmse == pytest.approx(math.sqrt(1.0 - found.r2))
    assert list(found.to_json()) == ["n", "rmse", "nrmse", "mae", "r2"]


def test_a_channel_that_does_not_vary_has_no_r2() -> None:
    found = channel_errors(np.full(4, 2.0), np.full(4, 2.2))
    assert math.isnan(found.r2)
    assert found.nrmse == pytest.approx(0.1)
    assert found.to_json()["r2"] is None
    assert channel_errors(np.full(2, np.nan), np.ones(2)).n == 0


@pytest.mark.parametrize(("share", "flat"), [(0.5, True), (3.0, False)])
def test_values_that_vary_by_rounding_alone_have_no_share_explained(share: float, flat: bool) -> None:
    measured = 7.0 * (1.0 + share * 1e-9 * (-1.0) ** np.arange(10))
    assert math.isnan(channel_errors(measured, measured).r2) == flat


def test_zeros_have_no_share_explained() -> None:
    assert math.isnan(channel_errors(np.zeros(3), np.array([0.0, 0.1, 0.0])).r2)


def test_a_share_of_one_is_said_of_nothing_less() -> None:
    shown = {0.5: "0.5", 0.99986: "0.99986", 0.9999968: "0.999997", 1 - 2e-8: "1", 1.0: "1", -3.0: "-3"}
    assert {value: share_text(value) for value in shown} == shown
    assert share_text(math.nan) == "nan"
