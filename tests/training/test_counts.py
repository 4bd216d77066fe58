"""Noise of counts: probabilities and information, gradients, fits against independent ones, tables and predictions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.stats import nbinom, norm, poisson

import gbspec
from gbspec.analysis import interval
from gbspec.diagnostics import Findings, UserError
from gbspec.ir import count_quantile
from gbspec.operations import evaluating, tables
from gbspec.training import TrainOptions, train
from gbspec.training.population import Counted, with_held
from gbspec.training.population.counts import NegativeBinomial, Poisson, likeliest_size, size_information
from gbspec.training.population.family import Family, Rows
from gbspec.training.population.objective import Objective
from gbspec.training.population.results import result_at
from tests.training.test_populations import marginal_of, model_of, table

pytestmark = pytest.mark.usefixtures("quick_fits")

DECAY = """model decay
time t from 0
state x
learn r = 0.5 in [0.01, 5]
learn x0 = 30 in [1, 1000]
learn k = 10 in [0.1, 1e4]
x' = -r*x
initial x = x0
observe y = 2*x noise negative_binomial(k) as "x"
"""
POISSON = DECAY.replace("negative_binomial(k)", "poisson").replace("learn k = 10 in [0.1, 1e4]\n", "")
EFFECTS = POISSON.replace("[1, 1000]", "[1, 1000] per trajectory ~ lognormal")
QUICK = TrainOptions(max_step=0.25, effort="low")
TIMES = np.linspace(0.25, 6, 24)


def rows(mean: object, value: object, shape: float = 1.0, number: float = 1.0) -> Rows:
    f, y = (torch.as_tensor(part, dtype=torch.float64) for part in (mean, value))
    one = torch.ones_like(f)
    variance = (f + f**2 / shape if np.isfinite(shape) else f) / number
    return Rows(f, y, variance, one, shape * one, number * one)


def decay(folder: Path, size: float | None, count: int = 2, seed: int = 3) -> np.ndarray:
    """Counts of decays from 60 at the rate 0.5, in `data.csv`."""
    random = np.random.default_rng(seed)
    mean = 60 * np.exp(-0.5 * TIMES) * np.ones((count, 1))
    values = random.poisson(mean if size is None else random.gamma(size, mean / size))
    table(folder, values.astype(float), TIMES)
    return values


def test_probabilities_are_those_of_the_distributions() -> None:
    mean, value = np.array([0.3, 4.0, 250.0, 3.0]), np.array([0.0, 7.0, 231.0, 12.0])
    found = Poisson().minus_two_log(rows(mean, value, np.inf)).numpy()
    assert found == pytest.approx(-2 * poisson.logpmf(value, mean), rel=1e-12)
    for size in (0.2, 3.0, 999.0, 1001.0, 1e7):
        found = NegativeBinomial().minus_two_log(rows(mean, value, size)).numpy()
        expected = -2 * nbinom.logpmf(value, size, size / (size + mean))
        assert found == pytest.approx(expected, rel=1e-7 if size > 1e5 else 1e-10)
    limit = NegativeBinomial().minus_two_log(rows(mean, value, 1e12)).numpy()
    assert limit == pytest.approx(-2 * poisson.logpmf(value, mean), rel=1e-8)


def test_an_average_counts_as_the_sum() -> None:
    found = NegativeBinomial().minus_two_log(rows([4.0], [17 / 3], 2.5, 3.0)).item()
    assert found == pytest.approx(-2 * nbinom.logpmf(17, 7.5, 7.5 / (7.5 + 12)))
    assert Poisson().minus_two_log(rows([4.0], [17 / 3], np.inf, 3.0)).item() == pytest.approx(
        -2 * poisson.logpmf(17, 12)
    )


@pytest.mark.parametrize("family", [Poisson(), NegativeBinomial()])
@pytest.mark.parametrize("number", [1.0, 3.0])
def test_the_derivative_by_the_mean_is_that_of_the_probability(family: Family, number: float) -> None:
    size = 2.5 if isinstance(family, NegativeBinomial) else np.inf
    f, y = torch.tensor([0.4, 5.0], dtype=torch.float64, requires_grad=True), [2.0, 3.0]
    half = 0.5 * family.minus_two_log(rows(f, y, size, number)).sum()
    (slope,) = torch.autograd.grad(half, f)
    assert family.by_mean(rows(f, y, size, number)).detach().numpy() == pytest.approx(slope.numpy(), rel=1e-12)


def test_counts_where_the_model_has_none_are_improbable_not_undefined() -> None:
    for family, size in ((Poisson(), np.inf), (NegativeBinomial(), 3.0)):
        at = rows([0.0, 0.0, -1.0, -1.0], [0.0, 4.0, 0.0, 4.0], size)
        found = family.minus_two_log(at).numpy()
        assert np.isfinite(found).all()
        assert found[[0, 2]] == pytest.approx(0.0, abs=1e-20)
        assert (found[[1, 3]] > 400).all()
        assert np.isfinite(family.by_mean(at).numpy()).all()
        assert np.isfinite(family.expected(at).numpy()).all()


@pytest.mark.parametrize("size", [0.3, 5.0, 80.0])
@pytest.mark.parametrize("mean", [0.05, 3.0, 200.0, 3000.0])
def test_the_information_of_the_size_is_its_expectation(size: float, mean: float) -> None:
    """The sum of squared scores over all counts, and none between mean and size."""
    y = np.arange(0, int(mean + 40 * (np.sqrt(mean + mean**2 / size) + 1)))
    k, f = (torch.full((len(y),), x, dtype=torch.float64, requires_grad=True) for x in (size, mean))
    at = Rows(f, torch.from_numpy(y).double(), f, f, k, torch.ones_like(f))
    half = 0.5 * NegativeBinomial().minus_two_log(at)
    by_size, by_mean = (d.numpy() for d in torch.autograd.grad(half.sum(), (k, f)))
    p = nbinom.pmf(y, size, size / (size + mean))
    expected = float(np.sum(p * by_size**2))
    assert size_information(np.array([mean]), np.array([size]))[0] == pytest.approx(expected, rel=1e-4)
    assert float(np.sum(p * by_size * by_mean)) == pytest.approx(0, abs=1e-6)


def test_the_information_of_many_values_is_interpolated() -> None:
    mean = np.geomspace(0.1, 1e4, 1000)
    found = size_information(mean, np.full(1000, 4.0))
    assert found[::100] == pytest.approx(size_information(mean[::100], np.full(10, 4.0)), rel=1e-4)


@pytest.mark.parametrize("size", [0.4, 6.0])
def test_the_likeliest_size_of_counts_of_known_expectation(size: float) -> None:
    random, number = np.random.default_rng(2), np.array([1.0, 3.0] * 200)
    mean = random.uniform(2, 300, 400)
    counts = random.negative_binomial(size * number, size / (size + mean)).astype(float)
    found = likeliest_size(counts / number, mean, number)

    def minus_log(k: float) -> float:
        return -float(nbinom.logpmf(counts, k * number, k / (k + mean)).sum())

    assert minus_log(found) <= min(minus_log(found * factor) for factor in (0.99, 1.01))
    assert found == pytest.approx(size, rel=0.25)
    nothing = likeliest_size(counts, np.zeros(400), number)
    assert np.isfinite(nothing) and nothing < 0.1, "counts where none are expected"


def test_the_likelihood_begins_with_the_size_that_the_pooled_fit_shows(tmp_path: Path) -> None:
    decay(tmp_path, 3.0)
    text = DECAY.replace("k = 10 in [0.1, 1e4]", "k = 5e3 in [0.1, 1e4]")
    model = model_of(text, tmp_path)
    run = train(model, tables.read_data(tmp_path / "data.csv", model, Findings()), QUICK, tmp_path / "run")
    begun = [float(row["k"]) for row in run.history() if row["stage"] == "search"][-1]
    assert begun == pytest.approx(run.fit.constants["k"].value, rel=0.3)


def test_one_size_of_two_channels_begins_at_the_likeliest_of_both(tmp_path: Path) -> None:
    decay(tmp_path, 3.0)
    lines = (tmp_path / "data.csv").read_text().splitlines()
    rows = [lines[0] + ",z", *(f"{line},{float(line.split(',')[2]) // 2}" for line in lines[1:])]
    (tmp_path / "data.csv").write_text("\n".join(rows) + "\n")
    second = 'observe z = x noise negative_binomial(k) as "z"\n'
    head, observed = DECAY.split("observe y")
    begun = []
    for text in (DECAY + second, head + second + "observe y" + observed):
        model, out = model_of(text, tmp_path), tmp_path / f"run{len(begun)}"
        run = train(model, tables.read_data(tmp_path / "data.csv", model, Findings()), QUICK, out)
        begun += [float(row["k"]) for row in run.history() if row["stage"] == "search"][-1:]
    assert begun[0] == pytest.approx(begun[1], rel=1e-3)


def test_residuals_and_draws_are_those_of_the_distribution() -> None:
    random = np.random.default_rng(1)
    for family, size in ((Poisson(), np.inf), (NegativeBinomial(), 3.0)):
        mean = np.full(20000, 6.0)
        at = rows(mean, np.zeros(20000), size)
        drawn = family.drawn(family.numbers(mean, random), mean, at.variance.numpy(), np.ones(20000))
        assert drawn.mean() == pytest.approx(6, rel=0.02)
        assert drawn.var() == pytest.approx(at.variance[0].item(), rel=0.05)
        residuals = family.normal_quantile(rows(mean, drawn, size))
        assert residuals.mean() == pytest.approx(0, abs=0.02)
        assert residuals.std() == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("text", [EFFECTS, EFFECTS.replace("poisson", "negative_binomial(5)")])
@pytest.mark.parametrize("nodes", [1, 3])
def test_the_gradient_is_that_of_the_likelihood(tmp_path: Path, text: str, nodes: int) -> None:
    decay(tmp_path, None, 4)
    model = model_of(text, tmp_path)
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    made, u, weights = marginal_of(model, data, nodes, 0.25)
    along, start, h = np.random.default_rng(3).standard_normal(len(u)), np.zeros((len(data), made.layout.effects)), 1e-4
    found = made.slopes(u, weights, made.value(u, weights, start).z)
    values = [made.value(u + s * h * along, weights, start).total for s in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    assert found.parameters.sum(axis=0) @ along == pytest.approx(numeric, rel=1e-6, abs=1e-5)
    assert np.linalg.eigvalsh(made.information(u, weights, start)).min() > 0


def test_the_likelihood_of_a_population_is_the_integral(tmp_path: Path) -> None:
    """A population of starts with Poisson counts, against an adaptive quadrature of each trajectory."""
    values = decay(tmp_path, None, 4)
    model = model_of(
        EFFECTS.replace("~ lognormal", "~ lognormal(0.4)").replace("learn x0 = 30", "learn x0 = 25"), tmp_path
    )
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    made, u, weights = marginal_of(model, data, 15, 0.125)
    total = 0.0
    for row in values:

        def logs(z: float, row: np.ndarray = row) -> float:
            return float(poisson.logpmf(row, 2 * 25 * np.exp(0.4 * z - 0.5 * TIMES)).sum() + norm.logpdf(z))

        best = max(map(logs, np.linspace(-3, 3, 601)))
        total -= 2 * (
            best + np.log(quad(lambda z, f=logs, b=best: np.exp(f(z) - b), -4, 4, limit=400, epsabs=1e-12)[0])
        )
    assert made.value(u, weights, np.zeros((4, 1))).total == pytest.approx(total, abs=1e-4)


@pytest.mark.parametrize("size", [None, 4.0])
def test_fits_are_those_of_an_independent_maximum(tmp_path: Path, size: float | None) -> None:
    values = decay(tmp_path, size, 3)
    model = model_of(POISSON if size is None else DECAY, tmp_path)
    found = train(model, tables.read_data(tmp_path / "data.csv", model, Findings()), QUICK, tmp_path / "run").fit

    def half(u: np.ndarray) -> float:
        mean = 2 * np.exp(u[1] - np.exp(u[0]) * TIMES)
        if size is None:
            return -float(poisson.logpmf(values, mean).sum())
        k = np.exp(u[2])
        return -float(nbinom.logpmf(values, k, k / (k + mean)).sum())

    start = np.log([0.4, 25.0] if size is None else [0.4, 25.0, 3.0])
    best = minimize(half, start, method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-11, "maxiter": 5000})
    assert found.population is not None
    assert found.population.minus2ll == pytest.approx(2 * best.fun, abs=1e-4)
    names = ["r", "x0"] if size is None else ["r", "x0", "k"]
    for name, value in zip(names, np.exp(best.x), strict=True):
        assert found.constants[name].value == pytest.approx(value, rel=1e-3)
    # The expected information, by the formulas of generalised linear models and Lawless (1987).
    mean = 2 * np.exp(best.x[1] - np.exp(best.x[0]) * TIMES)
    by = np.stack([-np.exp(best.x[0]) * TIMES * mean, mean], 1)
    variance = mean if size is None else mean + mean**2 / np.exp(best.x[2])
    expected = 3 * (by / variance[:, None]).T @ by
    sd = np.sqrt(np.diag(np.linalg.inv(expected))) * np.exp(best.x[:2])
    assert [found.constants[name].sd for name in ("r", "x0")] == pytest.approx(sd, rel=0.02)
    if size is not None:
        k = np.exp(best.x[2])
        of_size = 3 * sum(
            float(np.sum(nbinom.sf(np.arange(2000), k, k / (k + m)) / (k + np.arange(2000)) ** 2)) - m / (k * (k + m))
            for m in mean
        )
        assert found.constants["k"].sd == pytest.approx(1 / np.sqrt(of_size), rel=0.02)


def test_the_objective_at_a_point_is_the_probability(tmp_path: Path) -> None:
    values, mean = decay(tmp_path, 4.0), 60 * np.exp(-0.5 * TIMES)
    for text in (POISSON, DECAY):
        model = model_of(text, tmp_path)
        found = evaluating.of_model(model, tables.read_data(tmp_path / "data.csv", model, Findings())).found
        exact = poisson.logpmf(values, mean) if text is POISSON else nbinom.logpmf(values, 10, 10 / (10 + mean))
        assert found.nllh == pytest.approx(-exact.sum(), rel=1e-7)
        variance = mean if text is POISSON else mean + mean**2 / 10
        assert found.chi2 == pytest.approx(((values - mean) ** 2 / variance).sum(), rel=1e-6)


def test_replicates_are_summed(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_text("trajectory,t,name,value\n" + "".join(
        f"1,{t},x,{y}\n" for t, each in ((1, (3, 5, 9)), (2, (2, 2, 1))) for y in each
    ))  # fmt: skip
    model = model_of(POISSON, tmp_path)
    found = evaluating.of_model(model, tables.read_data(tmp_path / "data.csv", model, Findings())).found
    mean = 60 * np.exp(-0.5 * np.array([1, 2]))
    assert found.nllh == pytest.approx(-poisson.logpmf([17, 5], 3 * mean).sum(), rel=1e-7)


@pytest.mark.parametrize(
    ("rows_", "said"),
    [("1,2.5\n", "`x` is 2.5 in row 2, and counts are whole"), ("1,-3\n", "`x` is -3 in row 2")],
)
def test_what_is_no_count_is_refused(tmp_path: Path, rows_: str, said: str) -> None:
    (tmp_path / "data.csv").write_text(f"t,x\n{rows_}2,3\n")
    model = model_of(POISSON, tmp_path)
    with pytest.raises(UserError) as caught:
        tables.read_data(tmp_path / "data.csv", model, Findings())
    (one,) = caught.value.diagnostics
    assert one.code == "GB734"
    assert said in one.message


def test_standard_deviations_and_limits_of_counts_are_refused(tmp_path: Path) -> None:
    model = model_of(POISSON, tmp_path)
    (tmp_path / "data.csv").write_text("t,x,sd_x\n1,2,1\n2,3,1\n")
    with pytest.raises(UserError, match="GB734"):
        tables.read_data(tmp_path / "data.csv", model, Findings())
    (tmp_path / "data.csv").write_text("t,x\n1,<2\n2,3\n")
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    with pytest.raises(UserError, match="GB785"):
        train(model, data, QUICK, tmp_path / "run")


def test_intervals_are_quantiles_of_counts() -> None:
    mean = np.array([[0.0, 0.5, 20.0, 1000.0, np.nan]])
    low, high = interval(mean, np.sqrt(mean), False, counted=True)
    assert (low[0, :4] == poisson.ppf(0.05, mean[0, :4]).clip(0)).all()
    assert (high[0, :4] == poisson.ppf(0.95, mean[0, :4])).all()
    assert np.isnan(low[0, 4])
    wide = count_quantile(0.95, np.array([20.0]), np.array([60.0]))
    assert wide == nbinom.ppf(0.95, 10, 1 / 3)


def test_simulated_counts_are_counts_and_predictions_cover_them(tmp_path: Path) -> None:
    (tmp_path / "decay.gb").write_text(DECAY.replace("learn k = 10", "learn k = 3"))
    model = gbspec.load(tmp_path / "decay.gb")
    data = model.simulate(trajectories=20, span=6, dt=0.25, seed=4)
    values = np.concatenate([item.values[:, 0] for item in data.items])
    assert (values == np.round(values)).all()
    run = model.train(data, tmp_path / "run", effort="low", max_step=0.25)
    new = model.simulate(trajectories=20, span=6, dt=0.25, seed=5)
    found = run.predict(new)
    lows = np.concatenate([item.low[:, 0] for item in found.items])
    assert (lows >= 0).all()
    covered = found.errors()["y"].covered
    assert 0.87 < covered < 0.99


NETWORK = """model network
time t from 0
state x in [0, 40]
unknown f(x in [0, 40]) >= 0, zero at x = 0 by mlp(3)
x' = -f
initial x = 30
observe y = 2*x noise poisson as "x"
"""


@pytest.mark.parametrize("held", [0.2, 0.45, 0.9])
def test_the_likelihood_with_a_constant_held_is_that_of_an_independent_profile(tmp_path: Path, held: float) -> None:
    """What decides whether data leave a constant open: all others are refitted, from far off too."""
    values = decay(tmp_path, 4.0)
    model = model_of(DECAY, tmp_path)
    data = tables.read_data(tmp_path / "data.csv", model, Findings())
    made, _, weights = marginal_of(model, data, 1, 0.25)
    objective, modes = Objective(made), np.zeros((len(data), made.layout.effects))

    def minus2ll(x: np.ndarray, r: float) -> float:
        size, mean = np.exp(x[1]), 2 * np.exp(x[0]) * np.exp(-r * TIMES)
        return float(-2 * nbinom.logpmf(values, size, size / (size + mean)).sum())

    best = minimize(lambda x: minus2ll(x[:2], x[2]), [3.4, 1.4, 0.5], method="Nelder-Mead", options={"xatol": 1e-7})
    at = made.layout.bijections.from_natural(np.array([best.x[2], np.exp(best.x[0]), np.exp(best.x[1])]))
    found = result_at(objective, weights, at, modes, 0.0)
    assert found.point.minus2ll == pytest.approx(best.fun, abs=1e-3)
    value, point = with_held(Counted(objective), found.point, found.ridge, found.estimates.at("r"), held)
    expected = minimize(minus2ll, best.x[:2], (held,), method="Nelder-Mead", options={"xatol": 1e-7, "maxiter": 2000})
    assert value == pytest.approx(expected.fun, abs=0.05)
    assert point.minus2ll == pytest.approx(expected.fun, abs=0.05)


def test_a_network_is_learned_from_counts(tmp_path: Path) -> None:
    """Its fit is nearly as probable as the true function."""
    values = decay(tmp_path, None, 4)
    model = model_of(NETWORK, tmp_path)
    found = train(model, tables.read_data(tmp_path / "data.csv", model, Findings()), QUICK, tmp_path / "run").fit
    assert found.population is not None
    truth = -2 * poisson.logpmf(values, 60 * np.exp(-0.5 * TIMES)).sum()
    assert found.population.minus2ll < truth + 2
    assert found.population.ridge is not None


TWO = """model two
time t : h from 0
state x
learn k = 1.9 in [0.5, 2.5]
x' = 0
initial x = k - 1
observe y = if(t < 1, 25 - 20*x, if(t < 2, 4 - 3.98*x, 50 + 300*x*(1 - x))) noise poisson
"""


def test_minima_of_least_squares_are_judged_by_the_likelihood(tmp_path: Path) -> None:
    """25 where the model has 5 is as far off in least squares as 0 where it has 4 (counts of at least 1 are the
    weights), and in -2 log likelihood further by 32.5. From k = 1.9 the likelihood does not lead to 1."""
    (tmp_path / "m.gb").write_text(TWO)
    (tmp_path / "d.csv").write_text("t,y\n0.2,25\n0.7,25\n1.2,0\n1.7,0\n2.2,50\n2.7,50\n")
    fit = gbspec.load(tmp_path / "m.gb").train(tmp_path / "d.csv", tmp_path / "run").run.fit
    assert fit.constants["k"].value == pytest.approx(1, abs=0.01)
    assert not any("other constants" in text for text in fit.warnings)
