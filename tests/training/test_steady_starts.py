"""Steady starts in fits: exact derivatives by torch and the kernel, networks and conserved totals included."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.data.trajectories import Signal, Trajectories
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.training.engines import objective
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.engines.torch.failure import explain_failure
from tests.training.conftest import problem_of, trajectory
from tests.training.reference import linearise, measured_residuals, solve, unroll, whole_jacobian

BINDING = """
model binding
input L held = 1
condition I in [0.5, 2]
state R = 1
state C = 0
state Y = 0.5
learn kon = 1.1 in [0.1, 10]
learn koff = 0.5 in [0.05, 5]
learn total = 2 in [0.5, 5]
R' = -kon*L*R + koff*C
C' = kon*L*R - koff*C
Y' = C + 0.1*I - Y^2
initial R = total
initial steady with L = 0.3*I
observe C
observe Y
"""
NETWORK = """
model learned
input u held
condition I in [0.5, 2]
state a = 0.3
state b = 0.1
learn k = 0.7 in [0.1, 3]
unknown f(a, I) >= 0, decreasing in a by mlp(5)
a' = u*f - k*a
b' = a - k*b
initial steady
observe b
"""
PARTIAL = """
model partial
state a = 0.3
state b = 0.1
learn k = 0.7 in [0.1, 3]
a' = 0.2*b^2 + 1 - k*a
b' = a - k*b^3
initial a steady
initial b = 2*k
observe a
observe b
"""
SOME = """
model some
input L held = 1
condition I in [0.5, 2]
state R = 1
state C = 0.1
learn kon = 1.1 in [0.1, 10]
learn koff = 0.5 in [0.05, 5]
R' = -kon*L*R + koff*C
C' = kon*L*R - koff*C
initial steady with L = 0.3*I, I = 2*I then R = R + kon*I, C = 2*R*koff when I > 0.7
observe C
observe R
"""
CHOSEN = NETWORK.replace("initial steady", "initial steady when I > 0.7")


def model_of(text: str) -> Model:
    return load_model("m.gb", Findings(), lambda path: Source(str(path), text))


def rows(model: Model) -> Trajectories:
    rng, items = np.random.default_rng(2), []
    for i in range(3):
        times = np.sort(rng.uniform(0.1, 3.0, 6))
        signal = Signal(np.array([0.0, 1.0]), np.array([0.8 + 0.2 * i, 1.5]))
        items.append(
            trajectory(
                str(i),
                0.0,
                times,
                rng.uniform(0.3, 1.0, (6, len(model.channels))),
                [0.6 + 0.3 * i] * len(model.conditions),
                inputs=(signal,) * len(model.inputs),
            )
        )
    return Trajectories(tuple(items), tuple(c.name for c in model.channels))


def differences(function: Callable[[Array], Array], theta: Array, direction: Array, h: float = 1e-3) -> Array:
    total = np.zeros_like(function(theta))
    for weight, s in ((8, 1), (-1, 2)):
        total = total + weight * (function(theta + s * h * direction) - function(theta - s * h * direction))
    return total / (12 * h)


@pytest.mark.parametrize("text", [BINDING, NETWORK, PARTIAL, SOME, CHOSEN])
def test_derivatives_are_exact(text: str) -> None:
    model = model_of(text)
    problem, parameters, theta = problem_of(model, rows(model), 0.1)
    rng = np.random.default_rng(0)
    theta = theta + 0.3 * rng.standard_normal(len(theta))
    dense = whole_jacobian(linearise(problem, parameters, theta), parameters).numpy()
    vector = torch.from_numpy(theta).requires_grad_()
    residuals = measured_residuals(problem, unroll(problem, parameters, vector).residuals)
    weights = rng.standard_normal(len(residuals))
    (gradient,) = torch.autograd.grad((residuals * torch.from_numpy(weights)).sum(), vector)
    np.testing.assert_allclose(gradient.numpy(), weights @ dense, rtol=1e-8, atol=1e-9 * np.abs(gradient.numpy()).max())
    direction = rng.standard_normal(len(theta)) * 0.1
    expected = differences(lambda at: solve(problem, parameters, at), theta, direction)
    np.testing.assert_allclose(dense @ direction, expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("text", [BINDING, NETWORK, SOME, CHOSEN])
def test_the_kernel_gives_the_same(text: str) -> None:
    model = model_of(text)
    problem, parameters, theta = problem_of(model, rows(model), 0.1)
    native, graph = NativeEngine(problem, parameters, Kernel(model)), TorchEngine(problem, parameters)
    for one, other in zip(objective.half_squares(native, theta), objective.half_squares(graph, theta), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)
    found, expected = (whole_jacobian(objective.linearise(e, theta), parameters).numpy() for e in (native, graph))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


def test_second_derivatives_are_exact() -> None:
    model = model_of(NETWORK)
    problem, parameters, theta = problem_of(model, rows(model), 0.1)
    engine = TorchEngine(problem, parameters)
    path, rng = engine.plan(theta), np.random.default_rng(3)
    mean = engine.moments(theta, path).mean
    cotangent, direction = rng.standard_normal(mean.shape), 0.1 * rng.standard_normal(len(theta))
    found = engine.second(theta, path, direction, cotangent)
    expected = differences(lambda at: engine.pullback(at, engine.plan(at), cotangent), theta, direction)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_where_there_is_none_the_trajectory_and_the_state_are_named() -> None:
    model = model_of(
        "model m\ncondition c in [0, 9]\nstate x = 1\nlearn k = 1\nx' = 1 - c - k*x^2\ninitial steady\nobserve x\n"
    )
    items = [trajectory(n, 0.0, np.array([1.0, 2.0]), np.ones((2, 1)), [c]) for n, c in (("ok", 0.0), ("bad", 3.0))]
    problem, parameters, theta = problem_of(model, Trajectories(tuple(items), ("x",)), 0.1)
    with np.errstate(all="ignore"):
        error = explain_failure(problem, parameters, theta, "search")
    assert "there is no steady start of `x`" in error.what and "`bad`" in error.where
