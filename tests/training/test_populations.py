"""Populations: the marginal likelihood against closed forms, its derivatives, and fits from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import norm

from gbspec.backends import load_module
from gbspec.data import Limits, Trajectories, shipped_model
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir import METHODS, Model
from gbspec.operations import comparing, models, tables
from gbspec.training import TrainOptions, train
from gbspec.training.population import Layout, Marginal, Predictions
from gbspec.training.population.predictions import _Graph
from gbspec.training.recipe import build_context

LEVEL = """model level
state x
learn m = 5 in [-50, 50] per trajectory ~ normal(s)
learn s = 1 > 0
learn e = 0.5 > 0
x' = 0
initial x = m
observe x noise normal(e)
"""
"""A linear mixed model: its marginal likelihood is that of a normal distribution."""

DECAY = """model decay
time t from 0
state x
learn k = 0.5 in [0.01, 5] per trajectory ~ lognormal
learn x0 = 2 in [0.1, 20] per trajectory ~ lognormal
correlate k, x0
learn a = 0.1 in [1e-3, 1]
x' = -k*x
initial x = x0
observe x noise normal(sqrt(a^2 + (0.1*y)^2))
"""

NETWORK = """model network
time t from 0
state x in [0, 4]
effect e per trajectory
unknown f(x in [0, 4], e in [-3, 3])
    >= 0, zero at x = 0
    = 0.5*x*nn
    by mlp(3)
x' = -f(x, e)
initial x = 2
observe x
"""


PHENOBARBITAL = """model phenobarbital
time t : h from 0
state A : mg
learn CL : L/h = 0.006 in [0.0005, 0.1] per trajectory ~ lognormal
learn V : L = 1.4 in [0.1, 10] per trajectory ~ lognormal
dose A
A' = -CL/V*A
initial A = 0
observe conc = A/V : mg/L
"""
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"


def model_of(text: str, folder: Path) -> Model:
    (folder / "model.gb").write_text(text)
    findings = Findings()
    model = load_model(folder / "model.gb", findings)
    findings.raise_if_failed()
    return model


def table(folder: Path, values: np.ndarray, times: np.ndarray) -> Path:
    rows = ["trajectory,t,x"]
    rows += [f"{i + 1},{t},{y!r}" for i, row in enumerate(values.tolist()) for t, y in zip(times, row, strict=True)]
    (folder / "data.csv").write_text("\n".join(rows) + "\n")
    return folder / "data.csv"


def levels(folder: Path) -> tuple[Model, Trajectories, np.ndarray]:
    random = np.random.default_rng(1)
    values = 5 + 1.5 * random.standard_normal((8, 1)) + 0.4 * random.standard_normal((8, 4))
    model = model_of(LEVEL, folder)
    return model, tables.read_data(table(folder, values, np.arange(4.0)), model, Findings()), values


def decays(folder: Path, text: str = DECAY, count: int = 5) -> tuple[Model, Trajectories]:
    random, times = np.random.default_rng(2), np.array([0.5, 1.0, 2.0, 4.0])
    rate, start = (
        0.5 * np.exp(0.4 * random.standard_normal((count, 1))),
        2 * np.exp(0.2 * random.standard_normal((count, 1))),
    )
    values = start * np.exp(-rate * times) * (1 + 0.1 * random.standard_normal((count, 4)))
    model = model_of(text, folder)
    return model, tables.read_data(table(folder, values, times), model, Findings())


def marginal_of(
    model: Model, data: Trajectories, nodes: int = 1, step: float = 0.5
) -> tuple[Marginal, np.ndarray, np.ndarray]:
    """The marginal likelihood, u at the starts, and the networks' weights."""
    options = TrainOptions(backend="torch", max_step=step)
    context = build_context(model, load_module(model, METHODS["rk4"]), data, options, 0)
    fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = context.parameters(fixed)
    layout = Layout(parameters)
    names = tuple(k.name for k in layout.distributed)
    made = Marginal(layout, Predictions(context.problem(0.0), parameters, context.choice, names), nodes)
    theta = parameters.vector(context.module.weights)
    return made, theta[layout.slice()], theta[: parameters.n_weights]


def exact(values: np.ndarray, mean: float, spread: float, noise: float) -> float:
    """Minus twice the log likelihood of the linear mixed model."""
    n = values.shape[1]
    covariance = spread**2 * np.ones((n, n)) + noise**2 * np.eye(n)
    off = values - mean
    squares = np.einsum("ni,ij,nj->", off, np.linalg.inv(covariance), off)
    return float(values.size * np.log(2 * np.pi) + len(values) * np.linalg.slogdet(covariance)[1] + squares)


def assert_slopes_of_constants(made: Marginal, u: np.ndarray, weights: np.ndarray, tolerance: float) -> None:
    """The slopes of trajectories' constants are those of their modes, found again beside u."""
    likelihood, layout = made.likelihood, made.layout
    start = np.zeros((likelihood.groups.count, likelihood.groups.size))

    def constants(at: np.ndarray) -> np.ndarray:
        natural = layout.natural(made.rows(at))
        modes = torch.from_numpy(made.value(at, weights, start).z)
        return layout.constants(natural, likelihood.groups.numbers(modes))[0].numpy()[:, layout.place]

    slopes = made.individual_slopes(u, weights, made.value(u, weights, start).z)
    for p, step in enumerate(1e-3 * np.eye(len(u))):
        difference = (constants(u + step) - constants(u - step)) / 2e-3
        assert slopes[..., p] == pytest.approx(difference, rel=tolerance, abs=tolerance)


@pytest.mark.parametrize("text", [DECAY, NETWORK], ids=["decay", "network"])
def test_constants_follow_the_parameters_as_differences_say(tmp_path: Path, text: str) -> None:
    model, data = decays(tmp_path, text)
    made, u, weights = marginal_of(model, data)
    assert_slopes_of_constants(made, u, weights, 2e-5)


@pytest.mark.parametrize("nodes", [1, 3])
def test_the_likelihood_of_a_linear_model_is_exact(tmp_path: Path, nodes: int) -> None:
    model, data, values = levels(tmp_path)
    made, u, weights = marginal_of(model, data, nodes)
    found = made.value(u, weights, np.zeros((8, 1)))
    assert found.total == pytest.approx(exact(values, 5.0, 1.0, 0.5), rel=1e-10)


@pytest.mark.parametrize(
    ("text", "nodes"), [(DECAY, 1), (DECAY, 3), (NETWORK, 1)], ids=["laplace", "quadrature", "network"]
)
def test_the_gradient_is_that_of_the_likelihood(tmp_path: Path, text: str, nodes: int) -> None:
    model, data = decays(tmp_path, text)
    made, u, weights = marginal_of(model, data, nodes)
    random = np.random.default_rng(3)
    u, weights = u + 0.05 * random.standard_normal(len(u)), weights + 0.3 * random.standard_normal(len(weights))
    start = np.zeros((len(data), made.layout.effects))
    found = made.slopes(u, weights, made.value(u, weights, start).z)
    along, across = random.standard_normal(len(u)), random.standard_normal(len(weights))
    h = 1e-4
    values = [made.value(u + s * h * along, weights + s * h * across, start).total for s in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    exactly = found.parameters.sum(axis=0) @ along + found.weights @ across
    assert exactly == pytest.approx(numeric, rel=1e-6, abs=1e-6)


def limited(data: Trajectories, below: float, above: float) -> Trajectories:
    """The data with values that are known only to lie below or above a limit."""
    items = []
    for item in data.items:
        side = np.where(item.values < below, -1, np.where(item.values > above, 1, 0)).astype(np.int8)
        value = np.where(side < 0, below, np.where(side > 0, above, np.nan))
        items.append(replace(item, values=np.where(side == 0, item.values, np.nan), limits=Limits(value, side)))
    return replace(data, items=tuple(items))


def test_censored_values_contribute_their_probability(tmp_path: Path) -> None:
    """By quadrature with many nodes it is the integral over the level of each subject (M3)."""
    model, data, values = levels(tmp_path)
    made, u, weights = marginal_of(model, limited(data, 4.0, 7.0), 21)
    at = np.linspace(-8, 8, 4001)
    level = 5 + at[:, None]  # m = 5, s = 1, e = 0.5
    total = 0.0
    for row in values:
        known = row[(row >= 4) & (row <= 7)]
        logs = norm.logpdf(known, level, 0.5).sum(axis=1)
        logs += (row < 4).sum() * norm.logcdf(4, level[:, 0], 0.5) + (row > 7).sum() * norm.logsf(7, level[:, 0], 0.5)
        total += -2 * np.log(np.trapezoid(np.exp(logs) * norm.pdf(at), at))
    assert ((values < 4) | (values > 7)).any()
    assert made.value(u, weights, np.zeros((8, 1))).total == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("nodes", [1, 3])
def test_the_gradient_with_censored_values_is_exact(tmp_path: Path, nodes: int) -> None:
    model, data = decays(tmp_path)
    made, u, weights = marginal_of(model, limited(data, 0.4, 1.4), nodes)
    along, start, h = np.random.default_rng(3).standard_normal(len(u)), np.zeros((len(data), made.layout.effects)), 1e-4
    found = made.slopes(u, weights, made.value(u, weights, start).z)
    values = [made.value(u + s * h * along, weights, start).total for s in (-2, -1, 1, 2)]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    assert found.parameters.sum(axis=0) @ along == pytest.approx(numeric, rel=1e-6, abs=1e-6)


def test_a_fit_with_censored_values_and_a_learned_noise(tmp_path: Path) -> None:
    model, data, _ = levels(tmp_path)
    run = train(
        model, limited(data, 4.0, 7.0), TrainOptions(backend="torch", max_step=1.0, effort="low"), tmp_path / "r"
    )
    assert run.fit.constants["e"].value == pytest.approx(0.4, rel=0.4)


def test_the_sweeps_and_the_torch_graph_agree(tmp_path: Path) -> None:
    model, data = decays(tmp_path, NETWORK)
    made, u, weights = marginal_of(model, data)
    z = np.random.default_rng(4).standard_normal((len(data), 1))
    natural = made.layout.natural(made.rows(u))
    constants = made.layout.constants(natural, torch.from_numpy(z))[0]
    results = []
    for second in (made.predictions.second, _Graph(made.predictions)):
        k, w = constants.clone().requires_grad_(), torch.from_numpy(weights).requires_grad_()
        mean, sensitivity = second(k, w)
        total = (mean**2).sum() + (sensitivity**3).sum()
        results.append([mean, sensitivity, *torch.autograd.grad(total, [k, w])])
    for ours, reference in zip(*results, strict=True):
        torch.testing.assert_close(ours, reference, rtol=1e-9, atol=1e-9)


def test_the_lowest_of_several_minima_is_found(tmp_path: Path) -> None:
    """Further starts are looked at for few iterations only, and still lead to what full searches from them find."""
    model, data = decays(tmp_path, NETWORK)
    made, u, weights = marginal_of(model, data)
    steep = 6 * np.random.default_rng(11).standard_normal(len(weights))
    likelihood, natural = made.likelihood, made.layout.natural(made.rows(u))
    first = torch.full((len(data), 1), 2.5, dtype=torch.float64)
    alone = [
        likelihood.joint(of, z)
        for z, of in (likelihood.modes(natural, s * first, steep) for s in (1.0, 0.0, 0.6, -0.6))
    ]
    found, of = likelihood.lowest(natural, first, steep)
    best = torch.stack(alone).amin(0)
    assert float((alone[0] - best).max()) > 0.1, "there are several minima"
    assert float((likelihood.joint(of, found) - best).abs().max()) < 1e-6


def test_correlations_are_those_of_the_deviations(tmp_path: Path) -> None:
    model, data = decays(tmp_path)
    made, u, _ = marginal_of(model, data)
    place = next(iter(made.layout.correlations))
    natural = made.layout.natural(torch.from_numpy(u)).numpy()
    natural[place] = 0.6
    covariance = made.layout.covariance_of_deviations(natural)
    assert covariance == pytest.approx(np.array([[0.09, 0.6 * 0.09], [0.6 * 0.09, 0.09]]))


def test_a_fit_finds_the_maximum_of_the_likelihood_and_records_it(tmp_path: Path) -> None:
    model, data, values = levels(tmp_path)
    run = train(model, data, TrainOptions(backend="torch", max_step=1.0, effort="low"), tmp_path / "run")
    n, center = values.shape[1], values.mean(axis=1)
    within = ((values - center[:, None]) ** 2).sum() / (values.size - len(values))
    between = center.var() - within / n
    found = run.fit.population
    assert found is not None
    assert found.effects["m"].median == pytest.approx(center.mean(), rel=1e-5)
    assert found.effects["m"].sd == pytest.approx(np.sqrt(between), rel=1e-4)
    assert run.fit.constants["e"].value == pytest.approx(np.sqrt(within), rel=1e-4)
    assert found.minus2ll == pytest.approx(exact(values, center.mean(), np.sqrt(between), np.sqrt(within)), abs=1e-6)
    assert found.aic == pytest.approx(found.minus2ll + 6)
    own = run.fit.constants["m"].per_trajectory
    assert own is not None
    shrunk = center.mean() + (center - center.mean()) * between / (between + within / n)
    assert [own[str(i + 1)].value for i in range(8)] == pytest.approx(shrunk.tolist(), rel=1e-4)
    document = json.loads((tmp_path / "run" / "fit.json").read_text())
    assert set(document["population"]) >= {"minus2ll", "effects", "correlations"}
    assert document["objective"]["definition"].startswith("marginal likelihood")
    assert document["constants"]["m"]["value"] == document["population"]["effects"]["m"]["median"]


def test_without_distributions_no_way_to_integrate_is_named(tmp_path: Path) -> None:
    text = LEVEL.replace(" per trajectory ~ normal(s)", "").replace("learn s = 1 > 0\n", "")
    model, (_, data, _) = model_of(text, tmp_path), levels(tmp_path)
    run = train(model, data, TrainOptions(backend="torch", max_step=1.0, effort="low"), tmp_path / "run")
    assert run.fit.population is not None and run.fit.population.effects == {}
    assert run.fit.objective is not None
    assert run.fit.objective.definition == "likelihood: -2 log likelihood"


def test_runs_of_nested_models_are_compared(tmp_path: Path) -> None:
    model, data, _ = levels(tmp_path)
    options = TrainOptions(backend="torch", max_step=1.0, effort="low")
    larger = train(model, data, options, tmp_path / "larger")
    smaller = train(
        model_of(LEVEL.replace("learn s = 1 > 0", "const s = 3"), tmp_path), data, options, tmp_path / "smaller"
    )
    found = comparing.compare([larger, smaller])
    (test,) = found.tests
    assert (test.smaller, test.freedom) == (str(tmp_path / "smaller"), 1)
    assert test.fall == pytest.approx(found.runs[1].minus2ll - found.runs[0].minus2ll)
    assert 0 < test.p < 1
    assert "const s = 3" in found.differences[str(tmp_path / "smaller")]
    assert "AIC" in str(found)


def test_unseen_trajectories_are_drawn_and_start_from_the_median(tmp_path: Path) -> None:
    model, data, _ = levels(tmp_path)
    train(model, data, TrainOptions(backend="torch", max_step=1.0, effort="low"), tmp_path / "run")
    subject = models.learned(models.open_run(tmp_path / "run"))
    assert subject.individuals is not None
    random = np.random.default_rng(0)
    drawn = [subject.individuals.drawn(subject.evaluator, random, {}).constants[0] for _ in range(400)]
    assert np.mean(drawn) == pytest.approx(subject.evaluator.constants[0], abs=0.3)
    assert np.std(drawn) == pytest.approx(subject.individuals.factor[0, 0], rel=0.15)


@pytest.mark.parametrize(
    ("name", "natural", "minus2ll", "by_exact_hessian"),
    [
        ("theophylline", (1.590, 2.7515, 31.81, 0.634, 0.263, 0.138, 0.694), 359.403, 361.12),
        ("phenobarbital", (0.00589, 1.442, 0.445, 0.449, 2.796), 1010.473, 1010.04),
    ],
)
def test_published_likelihoods_are_found(
    tmp_path: Path, name: str, natural: tuple[float, ...], minus2ll: float, by_exact_hessian: float
) -> None:
    path = SHARED / f"{name}.csv"
    if not path.is_file():
        pytest.skip(f"{name}.csv is not there: the shared tables are not part of the project")
    bundled = shipped_model("theophylline_population").read_text(encoding="utf-8")
    model = model_of(bundled if name == "theophylline" else PHENOBARBITAL, tmp_path)
    data = tables.read_data(path, model, Findings())
    made, _, weights = marginal_of(model, data, step=0.2 if name == "theophylline" else 4.0)
    u = made.layout.bijections.from_natural(np.array(natural))
    found = made.value(u, weights, np.zeros((len(data), made.layout.effects)))
    assert found.total == pytest.approx(minus2ll, abs=0.05)
    # The reference is the least value, which lies at other estimates than those of the expected Hessian.
    assert by_exact_hessian < made.by_exact_hessian(u, weights, found.z) < by_exact_hessian + 0.3


def test_the_exact_hessian_is_the_second_derivative_of_the_joint_density(tmp_path: Path) -> None:
    model, data = decays(tmp_path)
    made, u, weights = marginal_of(model, data)
    found, h = made.value(u, weights, np.zeros((len(data), 2))), 1e-3
    natural = made.layout.natural(made.rows(u))

    def half(step: np.ndarray) -> np.ndarray:
        z = torch.from_numpy(found.z + step)
        return 0.5 * made.likelihood.joint(made.likelihood.plain(natural, z, weights), z).numpy()

    units = h * np.eye(2)
    hessian = np.array([[half(a + b) - half(a - b) - half(b - a) + half(-a - b) for a in units] for b in units])
    log_det = np.linalg.slogdet(np.moveaxis(hessian, 2, 0) / (4 * h**2))[1]
    expected = (2 * half(np.zeros(2)) + log_det).sum()
    assert made.by_exact_hessian(u, weights, found.z) == pytest.approx(expected, abs=1e-4)


def test_nodes_without_a_solution_leave_the_quadrature_and_its_gradient_finite(tmp_path: Path) -> None:
    """With long steps the solution grows beyond all bounds where the rate is large."""
    model, data = decays(tmp_path, DECAY.replace("learn k = 0.5 in", "learn k = 2 in"))
    made, u, weights = marginal_of(model, data, 9, step=0.5)
    start = np.zeros((len(data), 2))
    u[list(made.layout.names).index("sd_k")] += 2.0  # nodes far out: some rates are far above 2.8/0.5
    found = made.value(u, weights, start)
    assert np.isfinite(found.each).all()
    assert np.isfinite(made.slopes(u, weights, found.z).parameters).all()


def test_a_trajectory_without_a_solution_takes_no_derivatives_from_the_others(tmp_path: Path) -> None:
    """Else the inner problems of all of them stop where they are, and the likelihood is not finite."""
    model, data = decays(tmp_path)
    made, u, weights = marginal_of(model, data)
    individuals, natural = made.predictions.individuals, made.layout.natural(made.rows(u))
    constants = made.layout.constants(natural, torch.zeros((len(data), 2), dtype=torch.float64))[0].numpy()
    good = individuals.first(constants, weights)
    astray = constants.copy()
    astray[0, 0] = 1e80
    found, lost = individuals.first(astray, weights), made.predictions.measured.owner == 0
    assert np.isnan(found.mean[lost]).any()
    assert np.isnan(found.constants[lost]).all()
    np.testing.assert_allclose(found.constants[~lost], good.constants[~lost], rtol=1e-12)


def test_a_fit_by_quadrature_ends_at_its_maximum(tmp_path: Path) -> None:
    model, data = decays(tmp_path, count=12)
    options = TrainOptions(backend="torch", max_step=0.5, effort="low", quadrature=3)
    found = train(model, data, options, tmp_path / "run").fit.population
    assert found is not None
    assert found.nodes == 3
    made, u, weights = marginal_of(model, data, 3)
    names = {"median_k": ("k", "median"), "median_x0": ("x0", "median"), "sd_k": ("k", "sd"), "sd_x0": ("x0", "sd")}
    natural = made.layout.natural(torch.from_numpy(u)).numpy().copy()
    for name, (effect, what) in names.items():
        natural[made.layout.names[name]] = getattr(found.effects[effect], what)
    natural[made.layout.correlations[0]] = found.correlations["k"]["x0"]
    fit = json.loads((tmp_path / "run" / "fit.json").read_text())
    natural[made.layout.names["a"]] = fit["constants"]["a"]["value"]
    at = made.layout.bijections.from_natural(natural)
    value = made.value(at, weights, np.zeros((12, 2)))
    assert value.total == pytest.approx(found.minus2ll, abs=1e-6)
    assert np.abs(made.slopes(at, weights, value.z).parameters.sum(axis=0)).max() < 0.05


FEW = """model few
time t from 0
state x
learn k = 0.5 in [0.001, 50] per trajectory ~ lognormal
x' = -k*x
initial x = 1
observe x noise normal(0.15)
"""


@pytest.mark.parametrize(("times", "noise", "nodes"), [((1.0, 3.0), 0.15, 9), ((0.5, 1.0, 2.0, 3.0), 0.01, 1)])
def test_quadrature_follows_where_it_moves_a_parameter(
    tmp_path: Path, times: tuple[float, ...], noise: float, nodes: int
) -> None:
    """Two noisy values a subject, whose distributions are far from normal; four accurate ones, whose are not."""
    random = np.random.default_rng(0)
    rates = 0.5 * np.exp(random.standard_normal((8, 1)))
    values = np.exp(-rates * np.array(times)) + noise * random.standard_normal((8, len(times)))
    model = model_of(FEW.replace("0.15", str(noise)), tmp_path)
    data = tables.read_data(table(tmp_path, values, np.array(times)), model, Findings())
    run = train(model, data, TrainOptions(backend="torch", max_step=1.0, members=1), tmp_path / "run")
    found, stages = run.fit.population, [stage.name for stage in run.fit.members[0].stages]
    assert found is not None
    assert found.nodes == nodes
    assert ("quadrature" in stages) == (nodes > 1)
