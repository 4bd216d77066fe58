"""Derivatives of solutions with algebraic variables are exact: of graph, Jacobian, casadi and second order."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.backends.module import load_module
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories
from gbspec.training.engines.torch import TorchEngine
from tests.algebraic.models import ARRAY, BUFFER, UNKNOWN, built
from tests.events.test_derivatives import differences
from tests.training.conftest import problem_of, trajectory
from tests.training.reference import linearise, measured_residuals, unroll, whole_jacobian


def rows_of(channels: tuple[str, ...], scale: float, *, driven: bool = False) -> Trajectories:
    rng = np.random.default_rng(2)
    items = []
    for i in range(2):
        times = np.cumsum(rng.gamma(4, 0.1, 4 + i))
        values = scale * rng.uniform(0.5, 1.5, (len(times), len(channels)))
        signal = (Signal(np.array([0.0, 0.5, 1.5]), rng.uniform(0, 1, 3)),) if driven else ()
        doses = (DoseEvents(np.array([0.3]), np.array([0.2])),) if driven else ()
        items.append(trajectory(str(i), 0.0, times, values, [], inputs=signal, doses=doses))
    return Trajectories(tuple(items), channels)


CASES = [
    (BUFFER, rows_of(("pH", "a"), 0.03), 0.0),
    (UNKNOWN, rows_of(("x", "total"), 1.0, driven=True), 0.0),
    (UNKNOWN, rows_of(("x", "total"), 1.0, driven=True), 1.0),
    (ARRAY, rows_of((*(f"c_{i}" for i in (1, 2, 3)), *(f"q_{i}" for i in (1, 2, 3))), 1.0), 0.0),
]


@pytest.mark.parametrize(("text", "data", "blend"), CASES)
def test_the_jacobian_is_exact(text: str, data: Trajectories, blend: float) -> None:
    problem, parameters, theta = problem_of(built(text), data, 0.3, blend=blend)
    dense = whole_jacobian(linearise(problem, parameters, theta), parameters).numpy()
    assert np.isfinite(dense).all()
    vector = torch.from_numpy(theta).requires_grad_()
    residuals = measured_residuals(problem, unroll(problem, parameters, vector).residuals)
    rng = np.random.default_rng(5)
    weights = rng.standard_normal(len(residuals))
    (gradient,) = torch.autograd.grad((residuals * torch.from_numpy(weights)).sum(), vector)
    assert np.abs(gradient.numpy() - weights @ dense).max() < 1e-10 * np.abs(gradient.numpy()).max()
    direction = rng.standard_normal(len(theta))
    slope = dense @ direction
    expected = differences(problem, parameters, theta, direction, 1e-4)
    assert np.abs(expected - slope).max() < 1e-8 * np.abs(slope).max()


def test_second_derivatives_are_exact() -> None:
    problem, parameters, theta = problem_of(built(UNKNOWN), CASES[1][1], 0.4, blend=0.0)
    engine = TorchEngine(problem, parameters)
    rng = np.random.default_rng(6)
    u = rng.standard_normal(len(theta))
    v = rng.standard_normal(engine.moments(theta, engine.plan(theta)).mean.shape)
    second = engine.second(theta, engine.plan(theta), u, v)
    direction, h = rng.standard_normal(len(theta)), 1e-4

    def slope(at: Array) -> float:
        return float(engine.pullback(at, engine.plan(at), v) @ u)

    change = (slope(theta + h * direction) - slope(theta - h * direction)) / (2 * h)
    assert change == pytest.approx(float(second @ direction), rel=1e-6)


@pytest.mark.parametrize("text", [BUFFER, UNKNOWN, ARRAY])
def test_libraries_agree(text: str) -> None:
    model = built(text)
    member = load_module(model).random(3)
    rng = np.random.default_rng(4)
    n = len(model.states)
    x = rng.uniform(0.005, 0.04, (5, n)) if text is BUFFER else rng.uniform(0.2, 1.5, (5, n))
    u = rng.uniform(0, 1, (5, len(model.inputs)))
    constants = tuple(map(float, member.weights["constants"]))
    given = (np.full(5, 0.3), x, np.zeros((5, 0)), u, constants)
    arrays = member.arithmetic("numpy")
    rhs = member.equations.rhs(arrays, *given, member.numpy_networks())
    torch_rhs = member.rhs(0.3, torch.from_numpy(x), None, torch.from_numpy(u)).detach().numpy()
    function, jacobian = member.casadi_rhs(), member.casadi_jacobian()
    for i in range(5):
        assert np.abs(torch_rhs[i] - rhs[i]).max() < 1e-12
        assert np.abs(np.array(function(0.3, x[i], [], u[i])).ravel() - rhs[i]).max() < 1e-12
        at = torch.from_numpy(x[i])
        slopes = torch.autograd.functional.jacobian(lambda s, i=i: member.rhs(0.3, s, None, u[i]), at)
        assert np.abs(np.array(jacobian(0.3, x[i], [], u[i])) - slopes.numpy()).max() < 1e-10


def test_casadi_has_second_derivatives() -> None:
    member = load_module(built(BUFFER)).random(3)
    observe, x = member.casadi_observe(), ca.MX.sym("x", 2)
    slope = ca.Function("slope", [x], [ca.jacobian(observe(0, x, [], [])[0], x)])
    second = ca.Function("second", [x], [ca.hessian(observe(0, x, [], [])[0], x)[0]])
    at, h = np.array([0.02, 0.012]), 1e-7
    for i in range(2):
        step = h * np.eye(2)[i]
        change = (np.array(slope(at + step)) - np.array(slope(at - step))).ravel() / (2 * h)
        assert change == pytest.approx(np.array(second(at))[i], rel=1e-6)


def test_slopes_by_weights_are_those_of_differences() -> None:
    member = load_module(built(UNKNOWN)).random(1)
    x, by, u = np.array([[0.4], [1.1]]), np.ones((2, 1)), np.array([0.5])
    found = member.rhs_slopes(x, by, 0.2, np.zeros(0), u, member.weights["constants"])
    index, h = list(member.constants).index("s"), 1e-6

    def rhs(shift: float) -> Array:
        value = {"s": float(member.weights["constants"][index]) + shift}
        return np.asarray(member.rhs(0.2, x, None, u, value).detach().numpy()[:, 0])

    assert found["constants"][:, index] == pytest.approx((rhs(h) - rhs(-h)) / (2 * h), rel=1e-6)
