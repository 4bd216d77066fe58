"""Training of arrays of states: calls of a network for whole arrays in the Jacobian and in the warm start."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from gbspec.backends.module import load_module
from gbspec.data.sampling import SimulateOptions
from gbspec.data.shipped import shipped_models
from gbspec.data.trajectories import Trajectories
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.operations.models import reference
from gbspec.operations.tables import simulate
from gbspec.training import TrainOptions, train
from gbspec.training.recipe import planning
from gbspec.training.starts.slopes import FreeOutputs, Points, evaluate_rhs
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import linearise, measured_residuals, unroll, whole_jacobian

COLUMN = """model column
const N = 5
const h = 0.2
condition cin in [0, 2]
learn D = 0.02 in [0, 1]
state w in [0, 1]
state c[1..N] in [0, 2]
unknown r, s(c) by mlp(4, 3)
unknown q(c, w) = D*c + nn by mlp(3)
c[i]' = D*(c[i-1] - 2*c[i] + c[i+1])/h^2 - r(c[i]) - w*s(c[N+1-i]) + r(w) + q(c[i], w)*q(c[i], 0.5)
c[0] = cin
c[N+1] = c[N]
w' = sum(c)/N - w + q(0.3, 0.2) + s(c[2])
initial c[i] = 0.1*i
observe c[1]
observe c[4]
observe w
observe load = sum(c)*h + r(c[2])
"""


def column_data(seed: int = 0) -> Trajectories:
    """Random measurements, rows partly empty, trajectories of different lengths."""
    rng = np.random.default_rng(seed)
    items = []
    for i in range(2):
        times = np.cumsum(rng.gamma(4, 0.1, 2 + i))
        values = rng.uniform(0.3, 1.5, (len(times), 4))
        values[rng.random(values.shape) < 0.3] = np.nan
        items.append(trajectory(str(i), 0.0, times, values, [rng.uniform()]))
    return Trajectories(tuple(items), ("c[1]", "c[4]", "w", "load"))


def test_the_jacobian_equals_automatic_differentiation_and_that_of_the_model_written_out() -> None:
    model, data = model_of(COLUMN), column_data()
    problem, parameters, theta = problem_of(model, data, 0.5, blend=0.3)
    dense = whole_jacobian(linearise(problem, parameters, theta), parameters)
    expected = torch.func.jacrev(lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals))(
        torch.from_numpy(theta)
    )
    assert float((dense - expected).abs().max()) < 1e-10 * float(expected.abs().max())
    long, parameters, theta = problem_of(replace(model, arrays=(), families=()), data, 0.5, blend=0.3)
    written = whole_jacobian(linearise(long, parameters, theta), parameters)
    assert float((dense - written).abs().max()) < 1e-10 * float(expected.abs().max())


def test_free_outputs_stand_for_every_element() -> None:
    model = model_of(COLUMN)
    module = load_module(model).random(0)
    rng = np.random.default_rng(1)
    count, n = 4, len(model.states)
    points = Points(
        t=np.zeros(count),
        x=rng.uniform(0.2, 1.0, (count, n)),
        slope=np.zeros((count, n)),
        condition=np.full((count, 1), 0.7),
        inputs=np.zeros((count, 0)),
        trajectory=np.zeros(count, dtype=np.int64),
        equations=(),
        rough=(),
        scale=np.ones(n),
        measurements=1,
    )
    constants = torch.tensor([[5.0, 0.2, 0.02]] * count, dtype=torch.float64)
    free = FreeOutputs(model, count)
    evaluate_rhs(model, module, points, constants, free.functions())
    sizes = [(network, table.shape) for network, table in free.arguments]
    assert sorted(sizes) == sorted(
        [(0, (4, 1, 1)), (0, (4, 1, 1)), (0, (4, 5, 1)), (0, (4, 5, 1)), (1, (4, 1, 2)), (1, (4, 5, 2)), (1, (4, 5, 2))]
    )
    # With what the networks say at the recorded arguments in place of the free numbers, the same right-hand side.
    networks = module.numpy_networks()
    columns = []
    for network, table in free.arguments:
        columns += list(networks[network](*np.moveaxis(table, -1, 0)))
    free.values = torch.from_numpy(np.concatenate(columns, axis=1))
    assert free.values.shape[1] == len(free.neutral)
    found = evaluate_rhs(model, module, points, constants, free.functions())
    weights = {name: torch.from_numpy(value) for name, value in module.weights.items()}
    wanted = evaluate_rhs(model, module, points, constants, module.torch_networks(weights))
    assert torch.allclose(found, wanted, rtol=1e-12, atol=1e-13)


@cache
def spreading() -> tuple[Model, Trajectories]:
    """The bundled model on 24 reaches, and two trajectories of its truth."""
    model = load_model(shipped_models()["spreading_population"], Findings())
    assert len(model.states) == 24
    return model, simulate(reference(model), SimulateOptions(trajectories=2, span=4.0, dt=1.0))


@pytest.mark.usefixtures("quick_fit")
def test_a_pointwise_rate_is_learned_from_an_array(tmp_path: Path) -> None:
    model, data = spreading()
    run = train(model, data, TrainOptions(effort="low", max_step=0.5), tmp_path / "run")
    assert run.fit.constants["D"].value == pytest.approx(0.3, rel=0.02)
    u = torch.linspace(0.1, 0.9, 9, dtype=torch.float64)
    found = run.member().functions["g"](u).detach()
    assert float((found - 0.8 * u * (1 - u)).abs().max()) < 0.01


def test_many_states_are_fitted_without_a_jacobian(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.training.recipe.planning.PASSES", 10)
    monkeypatch.setattr("gbspec.training.starts.warm_start.ELIMINATION_WORK", 3e4)
    monkeypatch.setattr("gbspec.training.starts.warm_start.EVALUATIONS", 100)
    monkeypatch.setitem(planning.ALONE, "low", 15)  # type: ignore[arg-type]
    model, data = spreading()
    run = train(model, data, TrainOptions(effort="low", max_step=0.5), tmp_path / "run")
    stages = run.fit.members[0].stages
    assert [stage.name for stage in stages] == ["warm start", "lbfgs"]
    first, last = (stage.loss for stage in stages)
    assert first is not None and last is not None and last < 0.5 * first
