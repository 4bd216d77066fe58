"""Populations with stiff solvers and adaptive steps: likelihoods, exact gradients on the steps taken, and fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.backends import load_module
from gbspec.data import Trajectories
from gbspec.diagnostics import Findings
from gbspec.ir import METHODS, Model
from gbspec.operations import tables
from gbspec.training import TrainOptions, train
from gbspec.training.population import Layout, Marginal, Predictions
from gbspec.training.recipe import at_stable_step, build_context, chosen_solver, prepared
from tests.training.test_populations import model_of

BINDING = """model binding
time t from 0
condition dose in [0, 20] = 4
state C
state R
state P
const kon = {kon}
learn ke = 0.5 in [0.01, 5] per trajectory ~ lognormal
learn R0 = 1 in [0.1, 20] per trajectory ~ lognormal
learn kd = 1 in [0.01, 10]
learn a = 0.1 in [1e-3, 1]
C' = -ke*C - kon*C*R + kon/5*P
R' = kd*(R0 - R) - kon*C*R + kon/5*P
P' = kon*C*R - (kon/5 + 0.3)*P
initial C = dose
initial R = R0
initial P = 0
observe C noise lognormal(a)
"""
"""A drug that binds its target: fast where `kon` is large."""

DOSES = """model doses
time t from 0
state A
state C
learn ka = 20 in [0.1, 100]
learn ke = 0.5 in [0.01, 5] per trajectory ~ lognormal
learn share = 0.8 in [0.1, 1] per trajectory ~ lognormal
learn wait = 0.1 in [0, 1]
learn a = 0.1 in [1e-3, 1]
dose A times share lag wait
A' = -ka*A
C' = ka*A - ke*C
initial A = 0
initial C = 0
observe C noise normal(a)
"""

NETWORK = """model network
time t from 0
state x in [0, 4]
state y in [0, 4]
effect e per trajectory
unknown f(x in [0, 4], e in [-3, 3])
    >= 0, zero at x = 0
    = 0.5*x*nn
    by mlp(3)
x' = -f(x, e)
y' = 30*(x - y)
initial x = 2
initial y = 0
observe y
"""
TIMES = (0.05, 0.2, 0.5, 1.0, 2.0, 4.0)


def read(folder: Path, model: Model, lines: list[str]) -> Trajectories:
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    return tables.read_data(folder / "data.csv", model, Findings())


def binding(folder: Path, kon: float, count: int = 4) -> tuple[Model, Trajectories]:
    random, model = np.random.default_rng(5), model_of(BINDING.format(kon=kon), folder)
    lines = ["trajectory,t,dose,C"]
    for i in range(count):
        dose = (2.0, 8.0)[i % 2]
        lines += [f"{i},{t},{dose},{dose * np.exp(-0.6 * t + 0.2 * random.standard_normal())}" for t in TIMES]
    return model, read(folder, model, lines)


def dosed(folder: Path) -> tuple[Model, Trajectories]:
    model = model_of(DOSES, folder)
    lines = ["trajectory,t,C,dose_A"]
    for i in range(3):
        lines += [f"{i},0,,{3 + i}", *(f"{i},{t},{2 * np.exp(-0.4 * t)},{2 if t == 1 else ''}" for t in TIMES)]
    return model, read(folder, model, lines)


def networked(folder: Path) -> tuple[Model, Trajectories]:
    model = model_of(NETWORK, folder)
    rows = [f"{i},{t},{(2 + 0.3 * i) * np.exp(-0.5 * t)}" for i in range(2) for t in TIMES[1::2]]
    return model, read(folder, model, ["trajectory,t,y", *rows])


def marginal_of(
    made: tuple[Model, Trajectories], options: TrainOptions, nodes: int = 1
) -> tuple[Marginal, Array, Array]:
    """The marginal likelihood, u near the starts, and the networks' weights."""
    model, data = made
    context = build_context(model, load_module(model, METHODS[options.solver]), data, options, 0)
    fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = context.parameters(fixed)
    layout = Layout(parameters)
    names = tuple(k.name for k in layout.distributed)
    found = Marginal(layout, Predictions(context.problem(0.0), parameters, context.choice, names), nodes)
    theta = parameters.vector(context.module.weights)
    random = np.random.default_rng(3)
    u, weights = theta[layout.slice()], theta[: parameters.n_weights]
    return found, u + 0.05 * random.standard_normal(len(u)), weights + 0.3 * random.standard_normal(len(weights))


def stiff(tolerance: float, backend: Literal["auto", "torch"] = "auto") -> TrainOptions:
    return TrainOptions(backend=backend, solver="ros34pw2", tolerance=tolerance)


def start_of(made: Marginal) -> Array:
    return np.zeros((made.likelihood.count, made.likelihood.groups.size))


@pytest.mark.parametrize("solver", ["ros34pw2", "dopri5"])
def test_likelihood_and_gradient_are_those_of_short_explicit_steps(tmp_path: Path, solver: str) -> None:
    data = binding(tmp_path, 10.0)
    results = []
    for options in (
        TrainOptions(solver="rk4", max_step=0.01),
        TrainOptions(solver=solver, tolerance=1e-7),
    ):
        made, u, weights = marginal_of(data, options)
        value = made.value(u, weights, start_of(made))
        results.append((value.total, made.slopes(u, weights, value.z).parameters.sum(axis=0)))
    (short, slopes), (ours, gradient) = results
    assert ours == pytest.approx(short, rel=1e-5)
    np.testing.assert_allclose(gradient, slopes, rtol=2e-4, atol=1e-4 * np.abs(slopes).max())


def at_one_path(monkeypatch: pytest.MonkeyPatch, made: Marginal, u: Array, weights: Array) -> None:
    """Makes all solutions take the steps of the medians, with their matrices."""
    constants = made.likelihood.individual(made.layout.natural(made.rows(u)), torch.from_numpy(start_of(made)))[0]
    predictions = made.predictions
    path = predictions.individuals.path(constants.numpy(), weights)
    monkeypatch.setattr(predictions.individuals, "path", lambda *_: path)
    engine = getattr(predictions.second, "engine", None)
    if engine is not None:
        monkeypatch.setattr(engine, "plan", lambda _: path)


@pytest.mark.parametrize("case", [binding, dosed, networked])
def test_the_gradient_is_exact_on_the_steps_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: object
) -> None:
    """However coarse the steps are: here they have errors of a hundredth."""
    data = binding(tmp_path, 100.0) if case is binding else case(tmp_path)  # type: ignore[operator]  # one of three
    made, u, weights = marginal_of(data, stiff(1e-2))
    at_one_path(monkeypatch, made, u, weights)
    random = np.random.default_rng(4)
    found = made.slopes(u, weights, made.value(u, weights, start_of(made)).z)
    along, across, h = random.standard_normal(len(u)), random.standard_normal(len(weights)), 1e-4
    if "wait" in made.layout.names:
        along[made.layout.names["wait"]] = 0.0  # a lag moves the steps
    values = [
        made.value(u + s * h * along, weights + s * h * across, start_of(made)).total for s in (-2.0, -1.0, 1.0, 2.0)
    ]
    numeric = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    exactly = found.parameters.sum(axis=0) @ along + found.weights @ across
    assert exactly == pytest.approx(numeric, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("case", [binding, dosed])
def test_sensitivities_of_the_larger_model_are_the_derivatives_of_the_steps(tmp_path: Path, case: object) -> None:
    data = binding(tmp_path, 100.0) if case is binding else case(tmp_path)  # type: ignore[operator]  # one of two
    for backend in ("torch", "auto"):
        made, u, weights = marginal_of(data, stiff(1e-3, backend))
        constants = made.layout.constants(made.layout.natural(made.rows(u)), torch.zeros_like(made.rows(u))[:, :2])[0]
        predictions = made.predictions
        mean, sensitivity = predictions.first(constants.numpy(), weights)
        direct = predictions.individuals.first(constants.numpy(), weights)
        np.testing.assert_allclose(mean, direct.mean, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(sensitivity, direct.constants[:, made.layout.place], rtol=1e-9, atol=1e-11)


def test_a_stiff_population_is_fitted_by_the_solver_that_auto_chooses(tmp_path: Path) -> None:
    """Eigenvalues are near -1e4: explicit steps would have to be shorter than 3e-4. The tolerance stays as given."""
    random, kon, model = np.random.default_rng(11), 1000.0, model_of(BINDING.format(kon=1000.0), tmp_path)
    lines = ["trajectory,t,dose,C"]
    for i in range(8):
        ke, start, dose = 0.4 * np.exp(0.2 * random.standard_normal()), 2 * np.exp(0.2 * random.standard_normal()), 8.0

        def rates(t: float, x: Array, ke: float = ke, start: float = start) -> list[float]:
            bound = kon * x[0] * x[1] - kon / 5 * x[2]
            return [-ke * x[0] - bound, 0.5 * (start - x[1]) - bound, bound - 0.3 * x[2]]

        found = solve_ivp(rates, (0, 4), [dose, start, 0], "Radau", TIMES, rtol=1e-9, atol=1e-12).y[0]
        found *= np.exp(0.1 * random.standard_normal(len(found)))
        lines += [f"{i},{t},{dose},{x}" for t, x in zip(TIMES, found, strict=True)]
    data = read(tmp_path, model, lines)
    run = train(model, data, TrainOptions(effort="low", tolerance=1e-3), tmp_path / "run")
    assert run.fit.solver == "ros34pw2"
    assert "stiff" in (run.fit.solver_reason or "")
    assert "finer step" not in run.fit.members[0].stages
    for name, truth in (("ke", 0.4), ("R0", 2.0), ("kd", 0.5)):
        constant = run.fit.constants[name]
        assert constant.sd is not None
        assert abs(constant.value - truth) < 3 * constant.sd < truth, (name, constant)


QUICK_ABSORPTION = """model quick
time t from 0
state gut
state body in [0, 12]
learn ka = 6 in [0.5, 50] per trajectory ~ lognormal
unknown r(body in [0, 12]) >= 0, zero at body = 0 by mlp(3)
gut' = -ka*gut
body' = ka*gut - r
initial gut = 10
initial body = 0
observe body noise normal(0.2)
"""
"""Absorption at a rate of 6 with rows every 5: six times the stability limit of the default step of 1."""


def absorbed(folder: Path, times: tuple[int, ...] = (5, 10, 15, 20)) -> tuple[Model, Trajectories]:
    rows = ["trajectory,t,body"]
    rows += [f"{i},{t},{10 * np.exp(-0.1 * t) + 0.1 * (i - 2):.4f}" for i in range(5) for t in times]
    (folder / "data.csv").write_text("\n".join(rows) + "\n")
    model = model_of(QUICK_ABSORPTION, folder)
    return model, tables.read_data(folder / "data.csv", model, Findings())


def test_a_population_with_a_network_takes_smaller_explicit_steps(tmp_path: Path) -> None:
    model, data = absorbed(tmp_path)
    module, options = load_module(model, METHODS["rk4"]), TrainOptions(solver="auto", backend="torch")
    assert chosen_solver(model, module, data, options) == ("rk4", None)
    ready = prepared(model, module, data, options, 0)
    assert 6 * build_context(model, module, data, options, 0).max_step > 2.8
    assert 0.7 <= 6 * ready.context.max_step <= 1.4
    assert np.isfinite(ready.loss)
    context = build_context(model, module, data, options, 0)
    resumed = at_stable_step(context, context.parameters(ready.parameters.fixed), ready.theta)
    assert resumed.max_step == ready.context.max_step
    assert chosen_solver(model, module, data, replace(options, max_step=1.0))[0] == "ros34pw2"


def test_second_derivatives_of_stiff_steps_need_no_recomputed_graph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, data = absorbed(tmp_path, (5,))
    options = TrainOptions(solver="ros34pw2", backend="torch", tolerance=1e-2)
    context = build_context(model, load_module(model, METHODS["ros34pw2"]), data, options, 0)
    fixed = {k: v for k, v in context.module.weights.items() if k.endswith(("_center", "_scale"))}
    parameters = context.parameters(fixed)
    layout = Layout(parameters)
    made = Marginal(layout, Predictions(context.problem(0.0), parameters, context.choice, ("ka",)), 1)
    theta = parameters.vector(context.module.weights)
    u, weights = theta[layout.slice()], theta[: parameters.n_weights]
    z = np.zeros((5, 1))
    known = made.slopes(u, weights, z)
    monkeypatch.setattr("gbspec.training.engines.torch.memory.FEW", 0)
    monkeypatch.setattr("gbspec.training.engines.torch.memory.GRAPH_BYTES", 1)
    found = made.slopes(u, weights, z)
    assert np.array_equal(found.weights, known.weights)
    assert np.array_equal(found.parameters, known.parameters)


ORAL = """model oral
time t from 0
state gut
state body
learn ka = 0.7 in [0.05, 100]
learn CL = 12 in [1, 100] per trajectory ~ lognormal
learn V = 100 in [20, 500]
learn a = 0.1 in [1e-3, 1]
gut' = -ka*gut
body' = ka*gut - CL/V*body
initial gut = 0
initial body = 0
dose gut
observe c = body/V noise normal(a)
"""
"""Absorption at a rate of 0.7, which is slow, with rows every 25, so that the default step of 5 is long for it."""


def oral(folder: Path, ka: float) -> tuple[Model, Trajectories]:
    """A dose every 6 from a steady state of 20 doses on, absorbed at the rate `ka`."""
    model, lines = model_of(ORAL, folder), ["trajectory,t,c,dose_gut,ii_gut,ss_gut,addl_gut"]
    for i in range(4):
        k, lines = 0.1 + 0.02 * i, [*lines, f"{i},0,,200,6,20,13"]
        for t in (0.2 + i, 25.2 + i, 50.2 + i, 75.2 + i):
            since = t % 6 + 6 * np.arange(40)
            c = 2 * ka / (ka - k) * (np.exp(-k * since) - np.exp(-ka * since)).sum()
            lines.append(f"{i},{t},{c},,,,")
    return model, read(folder, model, lines)


def test_a_step_that_is_long_for_a_slow_rate_is_no_stiffness(tmp_path: Path) -> None:
    """The stiff solver took over ten times the steps, in each of which it has a matrix."""
    model, data = oral(tmp_path, 0.7)
    steps, options = {}, TrainOptions()
    assert chosen_solver(model, load_module(model, METHODS["rk4"]), data, options) == ("rk4", None)
    for solver in ("rk4", "ros34pw2"):
        ready = prepared(model, load_module(model, METHODS[solver]), data, options, 0)
        steps[solver] = ready.context.engine(ready.parameters, 0.0).plan(ready.theta).packed.substeps
    assert 5 * steps["rk4"] < steps["ros34pw2"]


def test_data_that_need_rates_beyond_a_smaller_step_get_the_stiff_solver(tmp_path: Path) -> None:
    model, data = oral(tmp_path, 20.0)
    solver, reason = chosen_solver(model, load_module(model, METHODS["rk4"]), data, TrainOptions())
    assert solver == "ros34pw2"
    assert "drawn from the ranges" in (reason or "")
