"""Learned starts and solutions below zero of states that are declared from zero."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.analysis.prediction.below_zero import said_of_ends
from gbspec.analysis.validation.step_check import StepCheck
from gbspec.arrays import Array
from gbspec.data import below_zero
from gbspec.training.engines import Moments
from gbspec.training.runs.negative_states import negative_states
from tests.training.conftest import model_of

MODEL = model_of(
    "model reservoir\ntime t : day\nstate S : mm in [0, 1000] = 100\nstate x in [0, 10]\nstate y in [-1, 10] = 1\n"
    "const S_1 : mm = 1\nlearn k : 1/day = 1 in [0.01, 10]\nlearn S_0 : mm = 3 in [0, 9]\nS' = -k*S\n"
    "x' = (S_0/S_1 - x)*k\n"
    "y' = -k*y\nobserve Q = k*S\nobserve x\nobserve z = y\n"
)


def solution(after: Array, initial: Array) -> Moments:
    return Moments(np.zeros((len(after), 3)), after, after, initial)


def test_values_clearly_below_zero_are_those_of_states_that_are_declared_from_zero() -> None:
    values = np.array([[-32.6, -0.3, -0.5], [140.0, 2.0, 5.0], [np.nan, 1.0, 1.0]])
    assert below_zero(MODEL, values) == {"S": -32.6, "x": -0.3}
    assert below_zero(MODEL, values, {"x": 0.2, "Q": 50.0}) == {"S": -32.6}, "the noise of x explains it"
    assert below_zero(MODEL, values * [0.3, 0.5, 1.0]) == {"S": pytest.approx(-9.78), "x": -0.15}
    assert below_zero(MODEL, np.array([[-9.0, -1e-9, 1.0], [140.0, 2.0, 1.0]])) == {}, "errors of a fit"


def test_a_start_below_zero_is_told_with_the_constant_that_keeps_it() -> None:
    rows = np.array([[-30.0, 1.0, 1.0], [140.0, 2.0, 1.0]])
    found = negative_states(MODEL, solution(rows, np.array([[-32.6, 1.0, 1.0]])), {"x": 0.1})
    assert list(found) == ["S"]
    assert "the learned start of `S` is -32.6, below 0" in found["S"]
    assert "`learn S_2 : mm = 100 in [0, 1000]`" in found["S"] and "`initial S = S_2`" in found["S"]
    text = negative_states(MODEL, solution(-rows, np.array([[3.0, 1.0, 1.0]])), {"x": 5.0})["S"]
    assert "the learned solutions take `S` to -140" in text
    text = negative_states(MODEL, solution(-rows, np.array([[-1e-6, 1.0, 1.0]])), {"x": 5.0})["S"]
    assert "the learned solutions take `S` to -140" in text, "a start of -1e-6 is not why"


def test_what_differs_between_solvers_is_put_down_to_negative_states() -> None:
    plain, told = (str(StepCheck(2e-8, 0.45, 0.05, 1, negative=names).warning) for names in ((), ("S",)))
    assert told.startswith(plain) and "`S` is below 0 at times" in told
    assert "`S`" in str(StepCheck(2e-8, None, 0.1, 0, 3, negative=("S",)).warning)


class Shown:
    failure = ""

    def __init__(self, mean: float) -> None:
        self.mean = np.array([[1.0, 1.0, 1.0, mean], [1.0, 1.0, 1.0, 140.0]])
        self.low, self.high = (self.mean + side * np.array([0.0, 0.0, 0.0, 60.0]) for side in (-1, 1))


def test_negative_predictions_are_not_said_to_be_impossible() -> None:
    (near,), (below,) = (said_of_ends(MODEL, [Shown(mean)], [0]) for mean in (20.0, -88.7))
    assert "negative ones are not" in near
    assert "themselves are negative (to -88.7)" in below and "negative ones are not" not in below
