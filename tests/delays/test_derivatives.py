"""Delays in training: solutions, and exact derivatives by states, constants, weights and the delays themselves."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data.trajectories import Signal, Trajectories
from gbspec.training.engines.choice import torch_engine
from gbspec.training.engines.objective import half_squares
from gbspec.training.engines.torch.failure import explain_failure
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.delays.models import EVERYTHING, MACKEY_GLASS, everything_data, mackey_glass
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import whole_jacobian


def haematopoiesis(step: float, rows: int = 20, end: float = 80.0) -> tuple[Problem, Parameters, Array]:
    """Mackey-Glass at times between the steps, from the true start."""
    times = np.linspace(0, end, rows + 1)[1:]
    data = Trajectories((trajectory("0", 0.0, times, np.full((rows, 1), 0.5), []),), ("P",))
    problem, parameters, _ = problem_of(model_of(MACKEY_GLASS), data, step, blend=0.0)
    truth = parameters.vector({}, np.array([17.0, 0.2, 0.1]))
    return problem, parameters, truth


def test_the_engine_the_module_and_another_method_agree() -> None:
    problem, parameters, theta = haematopoiesis(0.5)
    engine = torch_engine(problem, parameters)
    mean = engine.moments(theta, engine.plan(theta)).mean[:, 0]
    times, values = mackey_glass(17.0, 0.2, 0.1, 80.0)
    expected = np.interp(problem.packed.row_time, times, values)
    assert np.allclose(mean, expected, atol=2e-6)
    module = load_module(problem.model)({"constants": np.array([17.0, 0.2, 0.1])})
    own = module.simulate([0.5], [0.0, *problem.packed.row_time], max_step=0.5)[1:, 0].numpy()
    assert np.allclose(mean, own, atol=2e-7)


def test_the_order_is_four_through_the_propagated_start() -> None:
    ends = []
    for step in (4.0, 2.0, 1.0, 0.25):
        problem, parameters, theta = haematopoiesis(step)
        engine = torch_engine(problem, parameters)
        ends.append(engine.moments(theta, engine.plan(theta)).mean)
    errors = [float(np.abs(mean - ends[-1]).max()) for mean in ends[:-1]]
    assert errors[0] / errors[1] > 10 and errors[1] / errors[2] > 10


@pytest.mark.parametrize(("seed", "blend"), [(0, 0.0), (1, 0.4), (0, 1.0)])
def test_derivatives_agree_with_differences(seed: int, blend: float) -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(seed), 0.19, seed, blend=blend)
    engine = torch_engine(problem, parameters)
    path, rng = engine.plan(theta), np.random.default_rng(seed)
    moments = engine.moments(theta, path)
    assert moments.finite
    scale = rng.uniform(0.5, 2.0, problem.seen.shape)
    found = whole_jacobian(engine.jacobian(theta, path, moments, scale), parameters).numpy()
    for _ in range(2):
        direction, h = rng.standard_normal(len(theta)), 3e-6
        ahead, behind = (
            engine.moments(theta + s * h * direction, engine.plan(theta + s * h * direction)).mean for s in (1, -1)
        )
        change = (scale * (ahead - behind) / (2 * h))[problem.seen]
        assert np.allclose(found @ direction, change, rtol=1e-7, atol=2e-7 * np.abs(found).max())
    cotangent = np.where(problem.seen, rng.standard_normal(problem.seen.shape), 0.0)
    pulled = engine.pullback(theta, path, cotangent * scale)
    assert np.allclose(pulled, cotangent[problem.seen] @ found, rtol=1e-10, atol=1e-11 * np.abs(found).max())


def test_the_gradient_by_the_delay_is_that_of_the_solution() -> None:
    problem, parameters, theta = haematopoiesis(0.5)
    engine = torch_engine(problem, parameters)
    theta = parameters.vector({}, np.array([17.13, 0.2, 0.1]))  # whose echoes meet no other end of a step
    value, gradient = half_squares(engine, theta)
    place, h = parameters.places.start, 1e-5
    move = np.eye(len(theta))[place] * h
    change = (half_squares(engine, theta + move)[0] - half_squares(engine, theta - move)[0]) / (2 * h)
    assert np.isclose(gradient[place], change, rtol=1e-7)
    assert value > 0 and abs(gradient[place]) > 0


def test_single_precision_and_second_derivatives() -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(), 0.2, blend=0.0)
    engine = torch_engine(problem, parameters)
    rng = np.random.default_rng(0)
    direction = rng.standard_normal(len(theta))
    cotangent = np.where(problem.seen, rng.standard_normal(problem.seen.shape), 0.0)
    path, h = engine.plan(theta), 1e-5
    second = engine.second(theta, path, direction, cotangent)
    ahead, behind = (theta + s * h * direction for s in (1, -1))
    ends = [engine.pullback(one, engine.plan(one), cotangent) for one in (ahead, behind)]
    assert np.allclose(second, (ends[0] - ends[1]) / (2 * h), rtol=1e-5, atol=1e-6 * np.abs(second).max())
    single = torch_engine(problem, parameters, precision="float32")
    assert np.allclose(single.moments(theta, path).mean, engine.moments(theta, path).mean, rtol=1e-4)
    assert torch.get_default_dtype() == torch.float32


def test_a_solution_that_grows_without_bound_is_explained() -> None:
    text = "model m\ntime t from 0\nstate x\nlearn tau = 1 in [0.5, 2]\nx' = delay(x, tau)^2\ninitial x = 30\nobserve x"
    data = Trajectories((trajectory("0", 0.0, np.arange(1.0, 9.0), np.ones((8, 1)), []),), ("x",))
    problem, parameters, _ = problem_of(model_of(text), data, 0.5, blend=0.0)
    theta = parameters.vector({}, np.array([0.5]))
    found = explain_failure(problem, parameters, theta, "search")
    assert "not finite" in found.what and "x = " in found.where


def test_a_jump_of_an_input_arrives_a_learned_delay_later() -> None:
    """x' = F(t - tau), F from 0 to 2 at 1 and to 0.5 at 2: the solution is exact, and so is its derivative by tau."""
    text = "model m\ntime t from 0\nstate x\ninput F held\nlearn tau = 1 in [0.3, 2]\n"
    text += "x' = delay(F, tau)\ninitial x = 0\nobserve x"
    held = Signal(np.array([0.0, 1.0, 2.0]), np.array([0.0, 2.0, 0.5]))
    times = np.array([1.5, 2.0, 4.0])
    data = Trajectories((trajectory("0", 0.0, times, np.ones((3, 1)), [], inputs=(held,)),), ("x",))
    problem, parameters, _ = problem_of(model_of(text), data, 0.25, blend=0.0)
    theta = parameters.vector({}, np.array([0.73]))
    engine = torch_engine(problem, parameters)
    path = engine.plan(theta)
    moments = engine.moments(theta, path)
    assert np.allclose(moments.mean[:, 0], [0, 2 * 0.27, 2 + 0.5 * 1.27], atol=1e-12)
    slope = float(parameters.bijections(parameters.shared).derivative(theta[parameters.places])[0])
    found = whole_jacobian(engine.jacobian(theta, path, moments, np.ones((3, 1))), parameters).numpy()
    assert np.allclose(found[:, parameters.places.start] / slope, [0.0, -2.0, -0.5], atol=1e-12)
