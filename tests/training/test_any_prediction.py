"""Likelihoods have derivatives at any size of predictions: large ones, zero, and where a noise is a root."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec.data import Trajectories
from gbspec.diagnostics import Findings
from gbspec.ir import Model, residuals, slopes
from gbspec.operations import evaluating, tables
from gbspec.training import TrainOptions, train
from tests.training.test_populations import marginal_of, model_of

LEVEL = """model level
time t from 0
state x in [0, 1e7]
learn s = 900 in [1, 1e7]
learn a = 30 in [0.1, 1e4]
learn b = 0.1 in [0.001, 10]
x' = 0
initial x = s
observe q = x noise NOISE
"""
NOISES = ["poisson", "negative_binomial(a)", "normal(sqrt(a^2 + (b*y)^2))", "normal(b*sqrt(y))", "student(b*y, 5)"]
ANYWHERE = """model anywhere
time t from 0
state x
condition size
learn s = 1 in [0, 2] SPREAD
learn b = 0.2 in [0.001, 100]
x' = 0
initial x = s
observe q = size*x noise NOISE
observe w = 1 + x noise lognormal(0.1)
"""


def data_of(folder: Path, text: str, values: list[float]) -> tuple[Model, Trajectories]:
    (folder / "data.csv").write_text("t,q\n" + "".join(f"{t},{y:g}\n" for t, y in enumerate(values)))
    model = model_of(text, folder)
    return model, tables.read_data(folder / "data.csv", model, Findings())


@pytest.mark.parametrize("noise", NOISES)
def test_the_gradient_at_large_predictions_is_that_of_the_likelihood(noise: str, tmp_path: Path) -> None:
    """An exponential in a branch that is not taken overflows from 709.78 on."""
    model, data = data_of(tmp_path, LEVEL.replace("NOISE", noise), [950, 1010, 870])
    made, u, weights = marginal_of(model, data)
    along, start, h = np.random.default_rng(3).standard_normal(len(u)), np.zeros((1, 0)), 1e-4
    found = made.slopes(u, weights, start).parameters.sum(axis=0)
    values = [made.value(u + s * h * along, weights, start).total for s in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    assert found @ along == pytest.approx(numeric, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("noise", ["poisson", "normal(sqrt(a^2 + (b*y)^2))"])
def test_fits_with_large_predictions_move_and_warn_of_nothing(noise: str, tmp_path: Path) -> None:
    values = [2400.0, 2555.0, 2480.0, 2610.0, 2390.0]
    model, data = data_of(tmp_path, LEVEL.replace("NOISE", noise), values)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        fit = train(model, data, TrainOptions(effort="low"), tmp_path / "run").fit
    assert fit.constants["s"].value == pytest.approx(np.mean(values), rel=0.01)
    assert fit.population is not None
    if noise != "poisson":
        expected = 5 * (np.log(2 * np.pi * np.var(values)) + 1)
        assert fit.population.minus2ll == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("size", [0.0, 1e-310, 1e-200, -5.0, 800.0, 1e6])
@pytest.mark.parametrize(
    "noise", ["poisson", "negative_binomial(b)", "normal(b*sqrt(y))", "normal(1 + b*y)", "lognormal(b)"]
)
@pytest.mark.parametrize("spread", ["", "per trajectory ~ lognormal(0.3)"])
def test_where_there_is_a_likelihood_it_has_a_gradient(spread: str, noise: str, size: float, tmp_path: Path) -> None:
    """Beside a channel with logarithms, and with one trajectory of such predictions among others."""
    rows = [f"{i},{t},{size if i == 1 else 3},3,1.5" for i in (1, 2) for t in (1, 2, 3)]
    (tmp_path / "data.csv").write_text("\n".join(["trajectory,t,size,q,w", *rows]) + "\n")
    model = model_of(ANYWHERE.replace("SPREAD", spread).replace("NOISE", noise), tmp_path)
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    made, u, weights = marginal_of(model, data)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = made.value(u, weights, np.zeros((2, made.layout.effects)))
        if size < 0 and "sqrt" in noise:  # there is none
            assert not np.isfinite(found.total)
            return
        assert np.isfinite(found.total)
        assert np.isfinite(made.slopes(u, weights, found.z).parameters).all()
        assert np.isfinite(made.information(u, weights, found.z)).all()


def test_residuals_of_large_predictions_of_nothing_warn_of_nothing() -> None:
    """Beside a channel with logarithms the quotient by a measured zero is not computed."""
    predicted, measured, factor = np.array([[1e20, 2.0]]), np.array([[0.0, 4.0]]), np.array([1.0, 0.5])
    logs = np.array([False, True])
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert residuals(predicted, measured, factor, logs) == pytest.approx(np.array([[1e20, -0.5 * np.log(2)]]))
        assert slopes(predicted, measured, factor, logs) == pytest.approx(np.array([[1.0, 0.25]]))
    at = torch.from_numpy(predicted).requires_grad_()
    others = torch.from_numpy(measured), torch.from_numpy(factor)
    (found,) = torch.autograd.grad(residuals(at, *others, logs, torch).sum(), at)
    assert found.numpy() == pytest.approx(np.array([[1.0, 0.25]]))


def test_a_prediction_that_stays_zero_leaves_the_gradient_finite(tmp_path: Path) -> None:
    """The root of the noise has no derivative there, and no constant moves the prediction."""
    text = LEVEL.replace("x' = 0", "x' = s - x").replace("initial x = s", "initial x = 0")
    model, data = data_of(tmp_path, text.replace("NOISE", "normal(a + b*sqrt(y))"), [3.0, 610.0, 800.0])
    at = evaluating.of_model(model, data).found
    ends = [
        evaluating.of_model(
            model_of(text.replace("NOISE", "normal(a + b*sqrt(y))").replace("a = 30", f"a = {a}"), tmp_path), data
        ).found
        for a in (29.99, 30.01)
    ]
    assert at.gradient["a"] == pytest.approx((ends[1].nllh - ends[0].nllh) / 0.02, rel=1e-5)
    assert all(np.isfinite(list(at.gradient.values())))
