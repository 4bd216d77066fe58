"""Infusions and steady states in training: every engine has the closed form's solution, with exact derivatives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.data import Trajectories
from gbspec.data.table import read_frame
from gbspec.diagnostics import Findings
from gbspec.ir.model import Model
from gbspec.passes.claims import Verdict, decide
from gbspec.training import TrainOptions, train
from gbspec.training.engines.choice import native_engine, torch_engine
from gbspec.training.problem.parameters import Parameters
from gbspec.training.runs.steady import unsteady
from tests.training.conftest import model_of, problem_of
from tests.training.reference import linearise, measured_residuals, unroll, whole_jacobian

K, F = 0.4, 0.7
DRIP = f"""model drip
time t : h from 0
state A : mg in [0, 100]
condition D : h in [0, 5]
learn k : 1/h = {K} in [0.01, 5]
learn F = {F} in [0, 1]
dose A over D times F lag D/4
A' = -k*A
initial A = 0
observe A
"""


def drip_data(model: Model) -> Trajectories:
    """Infusions of 10 over 2 h and of 6 at a rate of 4, and 3 at once; arrivals are half an hour late."""
    table = {
        "t": [0, 1, 2.5, 3, 6, 8],
        "D": [2.0] * 6,
        "A": [0, 2, 4, 3, 4, 2],
        "dose_A": [10, None, 6, None, 3, None],
        "rate_A": [None, None, 4, None, 0, None],
    }
    return read_frame(table, model, Findings())


def infused(t: float, begin: float, lasts: float, amount: float, k: float = K) -> float:
    """The amount left of an infusion at time t, in closed form."""
    if t <= begin:
        return 0.0
    end = min(t, begin + lasts)
    return amount / lasts / k * (np.exp(-k * (t - end)) - np.exp(-k * (t - begin)))


def expected(t: float, k: float = K, fraction: float = F) -> float:
    at_once = 3 * np.exp(-k * (t - 6.5)) if t > 6.5 else 0.0  # a row comes before the dose
    return fraction * (infused(t, 0.5, 2, 10, k) + infused(t, 3, 1.5, 6, k) + at_once)


def constants(parameters: Parameters, theta: Array) -> tuple[float, float]:
    """k and F of a vector."""
    k, fraction = parameters.constants(torch.from_numpy(theta))[0].tolist()
    return k, fraction


def test_all_engines_have_the_closed_solution() -> None:
    model = model_of(DRIP)
    data = drip_data(model)
    item = data.items[0]
    wanted = [expected(float(t)) for t in item.times]
    evaluator = Evaluator(load_module(model)())
    found = evaluator.integrate(np.zeros(1), item.times, item.condition, item.inputs, 0.0, doses=item.doses)
    assert np.allclose(found[:, 0], wanted, rtol=1e-9, atol=1e-9)
    problem, parameters, theta = problem_of(model, data, 0.05, blend=0.0)
    for make in (torch_engine, native_engine):
        engine = make(problem, parameters)
        mean = engine.moments(theta, engine.plan(theta)).mean[:, 0]
        exact = [expected(float(t), *constants(parameters, theta)) for t in item.times]
        assert np.allclose(mean, exact, rtol=0, atol=2e-8)


def test_the_jacobian_with_infusions_in_a_steady_state_is_exact() -> None:
    model = model_of(DRIP)
    table = {"t": [0, 1, 5], "D": [2.0] * 3, "A": [None, 3, 2], "dose_A": [10, None, None], "ii_A": [4, None, None],
             "ss_A": [20, None, None]}  # fmt: skip
    problem, parameters, theta = problem_of(model, read_frame(table, model, Findings()), 0.5, blend=0.0)
    found = whole_jacobian(linearise(problem, parameters, theta), parameters)
    other = torch.autograd.functional.jacobian(
        lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals), torch.from_numpy(theta)
    )
    assert float((found - other).abs().max()) < 1e-10 * float(other.abs().max())


def test_many_doses_reach_the_periodic_solution() -> None:
    """In the periodic solution of a dose every T, what is left before a dose is a geometric series."""
    model = model_of(DRIP)
    table = {"t": [0, 4], "D": [2.0] * 2, "A": [None, 1], "dose_A": [10, None], "ii_A": [4, None], "ss_A": [1, None]}
    data = read_frame(table, model, Findings())
    problem, parameters, theta = problem_of(model, data, 0.1, blend=0.0)
    engine = torch_engine(problem, parameters)
    mean = engine.moments(theta, engine.plan(theta)).mean[-1, 0]
    k, fraction = constants(parameters, theta)
    assert mean == pytest.approx(fraction * infused(4, 0.5, 2, 10, k) / (1 - np.exp(-k * 4)), rel=1e-6)
    slow = np.array([[1e-3, F]])
    assert unsteady(load_module(model)(), data.items, np.array([[K, F]])) == []
    assert "does not begin in a steady state" in unsteady(load_module(model)(), data.items, slow)[0]


def test_claims_are_about_the_model_without_infusions() -> None:
    text = """model closed
state a = 1
state b = 0
a' = -a
b' = a
dose a over 2
conserve total = a + b
observe a
"""
    model = model_of(text)
    assert decide(model, model.claims[0]).verdict is Verdict.HOLDS


def test_a_fit_finds_the_constants(tmp_path: Path, quick_fit: None) -> None:
    model = model_of(DRIP.replace(f"= {K} in", "= 1.1 in").replace(f"F = {F} in", "F = 0.4 in"))
    table = {"t": list(np.arange(0, 9.0, 0.5))} | {"D": [2.0] * 18}
    values = [expected(float(t)) for t in table["t"]]
    doses: dict[str, list[float | None]] = {"dose_A": [None] * 18, "rate_A": [None] * 18}
    for row, amount, rate in ((0, 10, None), (5, 6, 4), (12, 3, 0)):
        doses["dose_A"][row], doses["rate_A"][row] = amount, rate
    data = read_frame(table | {"A": values} | doses, model, Findings())
    # The first of the doses lasts 2 h, as the condition says; expected() has the same doses.
    record = train(model, data, TrainOptions(effort="low"), tmp_path / "run").fit
    assert record.constants["k"].value == pytest.approx(K, rel=1e-4)
    assert record.constants["F"].value == pytest.approx(F, rel=1e-4)
