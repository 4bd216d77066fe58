"""Adaptive steps and frozen matrices: within the tolerance, the same by kernel and torch, with exact derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from gbspec.arrays import Array
from gbspec.data.trajectories import Trajectories
from gbspec.ir.methods import METHODS
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.native.control import Planner
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.inputs import Latest
from gbspec.training.engines.native.kernel import Kernel, kernel_of
from gbspec.training.engines.objective import predicted
from gbspec.training.engines.torch.planning import planned
from gbspec.training.problem.mesh import Control
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.backends.same_kernel import compare
from tests.training.conftest import EVERYTHING, everything_data, model_of, problem_of, trajectory
from tests.training.reference import linearise, measured_residuals, unroll, whole_jacobian
from tests.training.test_doses import MANY, many_data

ROBERTSON = """model robertson
time t from 0
state y1
state y2
state y3
learn k1 = 0.04 in [1e-5, 10]
learn k2 = 3e7 in [1e4, 1e10]
learn k3 = 1e4 in [10, 1e7]
y1' = -k1*y1 + k3*y2*y3
y2' = k1*y1 - k3*y2*y3 - k2*y2^2
y3' = k2*y2^2
initial y1 = 1
initial y2 = 0
initial y3 = 0
observe y1
observe y2
observe y3
"""
ADAPTIVE = ("ros34pw2", "dopri5")


def robertson_rhs(t: float, y: Any) -> list[float]:
    slow, fast = 0.04 * y[0] - 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
    return [-slow, slow - fast, fast]


def robertson_data(rows: int = 15, first: float = -3.0, last: float = 3.0) -> Trajectories:
    times = np.logspace(first, last, rows)
    found = solve_ivp(robertson_rhs, (0, times[-1]), [1, 0, 0], "Radau", times, rtol=1e-11, atol=1e-15)
    return Trajectories((trajectory("0", 0.0, times, found.y.T, []),), ("y1", "y2", "y3"))


def robertson(rtol: float | None, blend: float = 0.0) -> tuple[Problem, Parameters, Array]:
    """The reaction at its true rates."""
    data = robertson_data()
    found, parameters, _ = problem_of(model_of(ROBERTSON), data, 1e9, blend=blend, method=METHODS["ros34pw2"])
    return controlled(found, rtol, data.items[0].values.std(0)), parameters, parameters.vector(found.module.weights)


def controlled(problem: Problem, rtol: float | None, scale: Any = None) -> Problem:
    """The problem with adaptive steps."""
    size = np.ones(len(problem.model.states)) if scale is None else np.asarray(scale)
    return replace(problem, control=None if rtol is None else Control(rtol, size))


def kernel(problem: Problem) -> Kernel:
    found = kernel_of(problem.model, type(problem.module))
    if not isinstance(found, Kernel):
        pytest.skip(found.reason)
    return found


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_stiff_solutions_are_within_the_tolerance(rtol: float) -> None:
    problem, parameters, theta = robertson(rtol)
    engine = NativeEngine(problem, parameters, kernel(problem))
    path = engine.plan(theta)
    assert path.packed.substeps < 60 * rtol ** (-1 / 6), "steps far beyond the limit of explicit methods"
    found = engine.moments(theta, path).mean
    assert np.abs(found / problem.packed.values - 1).max() < 10 * rtol


GRID = """model grid
time t from 0
state s[1..7] = 0
learn k = 3 in [0.1, 30]
unknown f(x) by mlp(4)
s[i]' = k*(s[i-1] - 2*s[i] + s[i+1]) - f(s[i])
s[0] = 1
s[8] = 0
initial s[i] = 0
observe near = s[2]
observe far = s[6]
"""


def grid_data() -> Trajectories:
    times = np.array([0.3, 1.0, 2.5])
    items = [trajectory(str(i), 0.0, times, 0.1 * np.outer(times, [i + 2.0, 1.0]), []) for i in range(3)]
    return Trajectories(tuple(items), ("near", "far"))


CASES: dict[str, tuple[str, Any]] = {
    "inputs": (EVERYTHING, everything_data),
    "doses": (MANY, many_data),
    "grid": (GRID, grid_data),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ADAPTIVE)
@pytest.mark.parametrize("blend", [0.0, 1.0])
def test_kernel_and_torch_choose_the_same_steps(name: str, case: str, blend: float) -> None:
    text, make = CASES[case]
    problem, parameters, theta = problem_of(model_of(text), make(), 10.0, blend=blend, method=METHODS[name])
    problem = controlled(problem, 1e-5)
    given = Paths(problem).at(parameters, theta)
    ours = Planner(kernel(problem), Latest())(problem, parameters, theta, given)
    graph = planned(problem, parameters, theta, given)
    assert ours.packed.substeps > given.packed.substeps
    for field in ("t", "h", "inputs", "steps", "row_step"):
        np.testing.assert_allclose(getattr(ours.packed, field), getattr(graph.packed, field), rtol=1e-6, atol=1e-9)
    assert np.array_equal(ours.step, graph.step)
    if ours.factors is not None and graph.factors is not None:
        np.testing.assert_allclose(ours.factors.lu, graph.factors.lu, rtol=1e-5, atol=1e-8)
        assert np.array_equal(ours.factors.pivots, graph.factors.pivots)


def at_one_path(monkeypatch: pytest.MonkeyPatch, problem: Problem, parameters: Parameters, theta: Array) -> None:
    """Makes every engine use the steps that torch plans."""
    path = planned(problem, parameters, theta, Paths(problem).at(parameters, theta))
    monkeypatch.setattr(Paths, "at", lambda *_: path)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ADAPTIVE)
def test_derivatives_are_exact_and_the_same_by_kernel_and_graph(
    name: str, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, make = CASES[case]
    problem, parameters, theta = problem_of(model_of(text), make(), 10.0, blend=0.3, method=METHODS[name])
    problem = controlled(problem, 1e-3)
    kernel(problem)
    at_one_path(monkeypatch, problem, parameters, theta)
    compare(problem, parameters, theta, ("float64",))
    found = whole_jacobian(linearise(problem, parameters, theta), parameters)
    expected = torch.autograd.functional.jacobian(
        lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals),
        torch.from_numpy(theta),
        vectorize=True,
    )
    assert float((found - expected).abs().max()) < 1e-10 * float(expected.abs().max())


def test_derivatives_of_a_stiff_solution_are_those_of_the_steps_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, parameters, theta = robertson(1e-4)
    at_one_path(monkeypatch, problem, parameters, theta)
    found = whole_jacobian(linearise(problem, parameters, theta), parameters)[:, :3].numpy()
    engine = NativeEngine(problem, parameters, kernel(problem))

    def means(step: float, i: int) -> Array:
        there = theta + step * np.eye(len(theta))[i]
        return predicted(engine, there).mean / problem.scaling.row_scale

    for i in range(3):
        wide, narrow = ((means(s, i) - means(-s, i)) / (2 * s) for s in (2e-4, 1e-4))
        expected = (4 * narrow - wide) / 3
        assert np.abs(found[:, i] - expected[problem.seen]).max() < 1e-8 * np.abs(expected).max()


def test_the_graph_has_second_derivatives_of_stiff_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    from gbspec.training.engines.torch.engine import TorchEngine

    problem, parameters, theta = robertson(1e-2)
    at_one_path(monkeypatch, problem, parameters, theta)
    engine, rng = TorchEngine(problem, parameters), np.random.default_rng(0)
    path, direction = engine.plan(theta), np.eye(len(theta))[0]
    cotangent = np.where(problem.seen, rng.standard_normal(problem.seen.shape) / problem.scaling.row_scale, 0.0)
    found = engine.second(theta, path, direction, cotangent)
    step = 1e-5
    ends = [engine.pullback(theta + s * step * direction, path, cotangent) for s in (1, -1)]
    np.testing.assert_allclose(found, (ends[0] - ends[1]) / (2 * step), rtol=1e-5, atol=1e-6 * np.abs(found).max())


EXPLODING = """model exploding
time t from 0
state x
learn k = 1 in [0.1, 10]
x' = k*x^2
observe x
"""


@pytest.mark.parametrize("name", ADAPTIVE)
@pytest.mark.parametrize("blend", [0.0, 1.0])
def test_where_there_is_no_solution_there_are_no_numbers(name: str, blend: float) -> None:
    times, values = np.array([0.0, 0.5, 2.0, 2.1]), np.array([[1.0], [2.0], [0.1], [0.11]])
    data = Trajectories((trajectory("0", 0.0, times, values, []),), ("x",))
    problem, parameters, _ = problem_of(model_of(EXPLODING), data, 10.0, blend=blend, method=METHODS[name])
    problem = controlled(problem, 1e-4)
    parameters = replace(parameters, start_value=np.array([[1.0]]), start_free=np.zeros((1, 1)))
    theta = parameters.vector(problem.module.weights)
    for engine in (NativeEngine(problem, parameters, kernel(problem)), None):
        if engine is None:
            found = unroll(problem, parameters, torch.from_numpy(theta)).mean.detach().numpy()[:, 0]
        else:
            found = predicted(engine, theta).mean[:, 0]
        assert found[1] == pytest.approx(2.0, rel=1e-3), "1/(1 - t)"
        assert not np.isfinite(found[2]), "the solution ends at t = 1, and at 1 again after t = 0.5"
        assert np.isfinite(found[3]) == (blend == 1.0), "it begins anew where it is replaced"
