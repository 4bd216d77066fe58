"""Learned functions of populations have bands: from the covariance of weights and constants, as those of other fits."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gbspec.analysis import function_bands
from gbspec.diagnostics import Findings
from gbspec.operations import tables
from gbspec.runs import open_run
from gbspec.training import TrainOptions, train
from tests.training.test_populations import model_of, table

SATURATING = """model saturating
time t from 0
state x in [0, 6]
effect e per trajectory
learn s = 0.3 in [0.01, 2]
unknown r(x in [0, 6]) >= 0, zero at x = 0, increasing in x by mlp(4)
x' = -r*exp(s*e)
initial x = 5
observe x
"""


def _concentration(factor: float, times: np.ndarray) -> np.ndarray:
    rate = partial(lambda t, x, by: -by * 2 * x / (2 + x), by=factor)
    return np.asarray(solve_ivp(rate, (0, times[-1]), [5.0], t_eval=times, rtol=1e-8).y[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run: elimination 2 x/(2 + x) of 24 subjects, whose rates differ by a factor of which the logarithm has the
    standard deviation 0.3."""
    folder = tmp_path_factory.mktemp("population")
    random, times = np.random.default_rng(4), np.linspace(0.5, 8, 8)
    factors = np.exp(0.3 * random.standard_normal(24))
    values = np.array(
        [
            solve_ivp(lambda t, x, f=f: -f * 2 * x / (2 + x), (0, 8), [5.0], t_eval=times, rtol=1e-8).y[0]
            for f in factors
        ]
    )
    model = model_of(SATURATING, folder)
    noisy = values + 0.05 * random.standard_normal(values.shape)
    train(model, tables.read_data(table(folder, noisy, times), model, Findings()), TrainOptions(), folder / "run")
    return folder


def test_the_true_function_lies_in_the_band(folder: Path) -> None:
    points = np.linspace(0.2, 4.8, 24)[:, None]
    value, low, high = function_bands(open_run(folder / "run"), "r", points)
    truth = 2 * points[:, 0] / (2 + points[:, 0])
    assert np.all((low <= value) & (value <= high))
    assert np.mean((low <= truth) & (truth <= high)) >= 0.8
    assert np.mean(high - low) < 0.3  # the spread of the factors, 0.3/sqrt(24) of a rate of 1, and no more by far


def test_the_covariance_is_that_of_the_reported_constants(folder: Path) -> None:
    run = open_run(folder / "run")
    known = run.certainties().covariance
    assert known is not None and known.constants == ("s",)
    sd = known.deviations(np.zeros((1, known.vectors.shape[1])), np.ones((1, 1)))
    assert sd[0] == pytest.approx(run.fit.constants["s"].sd, rel=1e-6)


def test_where_the_function_was_trained_is_kept(folder: Path) -> None:
    support = open_run(folder / "run").certainties().support["r"]
    assert set(support.owner) == set(range(24))
    assert 0 < support.points.min() < 1 < 4 < support.points.max() < 6
