"""Student's noise: its density and information, exact gradients, and fits that outliers do not move."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm
from scipy.stats import t as student_t

from gbspec.analysis import noise_at
from gbspec.data import Limits
from gbspec.diagnostics import Findings, UserError
from gbspec.operations import evaluating, tables
from gbspec.training import TrainOptions, train
from gbspec.training.population import student
from tests.training.test_populations import DECAY, LEVEL, decays, levels, marginal_of, model_of, table

pytestmark = pytest.mark.usefixtures("quick_fits")

OUTLIERS = """model outliers
time t from 0
state x
learn k = 0.5 in [0.01, 5]
learn x0 = 2 in [0.1, 20]
learn s = 0.1 in [1e-3, 2]
learn df = 5 in [1, 100]
x' = -k*x
initial x = x0
observe x noise student(s, df)
"""
HEAVY = DECAY.replace("normal(sqrt(a^2 + (0.1*y)^2))", "student(sqrt(a^2 + (0.1*y)^2), df)\nlearn df = 4 in [1, 50]")
QUICK = TrainOptions(max_step=0.5, effort="low")


def spoiled(folder: Path) -> np.ndarray:
    """Two decays with small errors, in which one value of eight is far off."""
    random, times = np.random.default_rng(5), np.linspace(0.25, 6, 24)
    values = 2 * np.exp(-0.5 * times) * np.ones((2, 1)) + 0.02 * random.standard_normal((2, 24))
    values[:, 3::8] += 1.5
    table(folder, values, times)
    return values


def test_the_density_and_its_information_are_those_of_the_distribution() -> None:
    residual, scale, freedom = torch.tensor([0.3, -2.0]), torch.tensor([0.5, 0.7]), torch.tensor([2.5, 7.0])
    found = student.minus_two_log(residual, scale**2, freedom).double().numpy()
    assert found == pytest.approx(-2 * student_t.logpdf(residual, freedom, scale=scale), rel=1e-5)
    n = 3.7

    def scores(r: float) -> np.ndarray:
        at = torch.tensor([0.0, 0.0, n], dtype=torch.float64, requires_grad=True)
        half = 0.5 * student.minus_two_log(r - at[0], torch.exp(2 * at[1]), at[2])
        return torch.autograd.grad(half, at)[0].numpy()

    information = [
        [
            quad(lambda r, i=i, j=j: scores(r)[i] * scores(r)[j] * student_t.pdf(r, n), -np.inf, np.inf, limit=200)[0]
            for j in range(3)
        ]
        for i in range(3)
    ]
    one, free = torch.tensor(1.0, dtype=torch.float64), torch.tensor(n, dtype=torch.float64)
    of_mean = float(student.expected(one, torch.zeros_like(one), free))
    scale_, own, between = (float(x) for x in student.of_scale_and_freedom(np.array(n)))
    expected = [[of_mean, 0, 0], [0, scale_, between], [0, between, own]]
    assert np.array(information) == pytest.approx(np.array(expected), abs=1e-7)
    assert student.equivalent(np.array(1.0), np.array(n)) == pytest.approx(1 / of_mean)
    assert student.normal_quantile(np.array([-3.0, 0.0, 2.0]), np.array(n)) == pytest.approx(
        norm.ppf(student_t.cdf([-3.0, 0.0, 2.0], n)), abs=1e-12
    )


@pytest.mark.parametrize("nodes", [1, 3])
def test_the_gradient_is_that_of_the_likelihood(tmp_path: Path, nodes: int) -> None:
    model, data = decays(tmp_path, HEAVY)
    made, u, weights = marginal_of(model, data, nodes)
    along, start, h = np.random.default_rng(3).standard_normal(len(u)), np.zeros((len(data), made.layout.effects)), 1e-4
    found = made.slopes(u, weights, made.value(u, weights, start).z)
    values = [made.value(u + s * h * along, weights, start).total for s in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    assert found.parameters.sum(axis=0) @ along == pytest.approx(numeric, rel=1e-6, abs=1e-6)
    information = made.information(u, weights, start)
    assert np.linalg.eigvalsh(information).min() > 0


def test_the_likelihood_is_the_integral_over_the_levels(tmp_path: Path) -> None:
    _, data, values = levels(tmp_path)
    model = model_of(LEVEL.replace("normal(e)", "student(e, 4)"), tmp_path)
    made, u, weights = marginal_of(model, data, 31)
    at, total = np.linspace(-8, 8, 4001), 0.0
    for row in values:  # m = 5, s = 1, e = 0.5
        density = np.exp(student_t.logpdf(row, 4, 5 + at[:, None], 0.5).sum(axis=1)) * norm.pdf(at)
        total += -2 * np.log(np.trapezoid(density, at))
    assert made.value(u, weights, np.zeros((8, 1))).total == pytest.approx(total, rel=1e-5)


def test_outliers_do_not_move_the_constants(tmp_path: Path) -> None:
    spoiled(tmp_path)
    found = {}
    for kind, noise in (("student", "student(s, df)"), ("normal", "normal(s)")):
        text = OUTLIERS.replace("student(s, df)", noise)
        text = text if kind == "student" else text.replace("learn df = 5 in [1, 100]\n", "")
        model = model_of(text, tmp_path)
        data = tables.read_data(tmp_path / "data.csv", model, Findings())
        found[kind] = train(model, data, QUICK, tmp_path / kind).fit
    k = {kind: fit.constants["k"].value for kind, fit in found.items()}
    assert k["student"] == pytest.approx(0.5, rel=0.02)
    assert abs(k["normal"] - 0.5) > 0.05  # the outliers are there
    assert found["student"].constants["s"].value == pytest.approx(0.02, rel=0.5)
    assert found["student"].constants["df"].value < 3
    interval = found["student"].constants["k"].interval
    assert interval is not None
    assert interval[0] < 0.5 < interval[1]
    ours, normal = found["student"].population, found["normal"].population
    assert ours is not None
    assert normal is not None
    assert ours.aic is not None
    assert normal.aic is not None
    assert ours.aic < normal.aic - 20


def test_intervals_of_predictions_are_those_of_the_distribution(tmp_path: Path) -> None:
    spoiled(tmp_path)
    model = model_of(OUTLIERS.replace("learn df = 5 in [1, 100]", "const df = 3"), tmp_path)
    run = train(model, tables.read_data(tmp_path / "data.csv", model, Findings()), QUICK, tmp_path / "run")
    wide = noise_at(run, np.ones(1))[0] * norm.ppf(0.95)
    assert wide == pytest.approx(run.fit.constants["s"].value * student_t.ppf(0.95, 3), rel=1e-9)


def test_the_objective_at_a_point_is_the_density(tmp_path: Path) -> None:
    values = spoiled(tmp_path)
    model = model_of(OUTLIERS, tmp_path)
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    found = evaluating.of_model(model, data).found
    mean = 2 * np.exp(-0.5 * np.linspace(0.25, 6, 24))
    assert found.nllh == pytest.approx(-student_t.logpdf(values, 5, mean, 0.1).sum(), rel=1e-6)
    h = 1e-4
    ends = [-student_t.logpdf(values, 5 + sign * h, mean, 0.1).sum() for sign in (-1, 1)]
    assert found.gradient["df"] == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-5)


def test_censored_values_are_refused(tmp_path: Path) -> None:
    model, data = decays(tmp_path, HEAVY)
    side = np.zeros_like(data.items[0].values, dtype=np.int8)
    side[0] = -1
    limits = Limits(np.where(side < 0, 0.1, np.nan), side)
    first = replace(data.items[0], values=np.where(side < 0, np.nan, data.items[0].values), limits=limits)
    with pytest.raises(UserError) as caught:
        train(model, replace(data, items=(first, *data.items[1:])), QUICK, tmp_path / "run")
    assert [found.code for found in caught.value.diagnostics] == ["GB785"]
