"""Derivatives of solutions with events equal differences of tight tolerance, and all events are where they belong."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gbspec.arrays import Array
from gbspec.data.trajectories import DoseEvents, Signal, Trajectories
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem
from tests.events.models import BALL, MIXED, THERMOSTAT
from tests.training.conftest import model_of, problem_of, trajectory
from tests.training.reference import linearise, measured_residuals, solve, unroll, whole_jacobian


def some_rows(channels: int, rows: int, span: float) -> Trajectories:
    times = np.linspace(0.0, span, rows + 1)[1:] + 0.0137
    values = np.random.default_rng(1).uniform(0.5, 1.5, (rows, channels))
    return Trajectories((trajectory("1", 0.0, times, values, []),), tuple("hn"[:channels]))


def mixed_rows() -> Trajectories:
    items = []
    rng = np.random.default_rng(4)
    for i in range(3):
        times = np.linspace(0.0, 3.0, 13)
        signal = Signal(np.array([0.0, 1.1, 2.0, 3.0]), np.array([0.2, 0.9 + 0.1 * i, 0.1, 1.2]))
        doses = DoseEvents(np.array([0.4, 1.7]), np.array([0.5, 0.8]))
        values = rng.uniform(0.3, 1.5, (13, 2))
        items.append(trajectory(str(i), 0.0, times, values, [], inputs=(signal,), doses=(doses,)))
    return Trajectories(tuple(items), ("a", "total"))


def differences(problem: Problem, parameters: Parameters, theta: Array, direction: Array, h: float = 1e-4) -> Array:
    """Central differences of order four."""
    total = np.zeros_like(solve(problem, parameters, theta))
    for weight, s in ((8, 1), (-1, 2)):
        ahead, behind = (solve(problem, parameters, theta + sign * s * h * direction) for sign in (1, -1))
        total += weight * (ahead - behind)
    return total / (12 * h)


@pytest.mark.parametrize(("text", "data", "step", "blend"), [
    (BALL, some_rows(2, 10, 3.0), 0.15, 0.0),
    (THERMOSTAT, some_rows(1, 10, 8.0), 0.4, 0.0),
    (MIXED, mixed_rows(), 0.2, 0.0),
    (MIXED, mixed_rows(), 0.2, 1.0),
])  # fmt: skip
def test_the_jacobian_is_exact(text: str, data: Trajectories, step: float, blend: float) -> None:
    the_jacobian_is_exact(text, data, step, blend)


def the_jacobian_is_exact(text: str, data: Trajectories, step: float, blend: float) -> None:
    """Compares the Jacobian, the graph's gradient and differences."""
    problem, parameters, theta = problem_of(model_of(text), data, step, blend=blend)
    dense = whole_jacobian(linearise(problem, parameters, theta), parameters).numpy()
    vector = torch.from_numpy(theta).requires_grad_()
    residuals = measured_residuals(problem, unroll(problem, parameters, vector).residuals)
    rng = np.random.default_rng(5)
    weights = rng.standard_normal(len(residuals))
    (gradient,) = torch.autograd.grad((residuals * torch.from_numpy(weights)).sum(), vector)
    assert np.abs(gradient.numpy() - weights @ dense).max() < 1e-9 * np.abs(gradient.numpy()).max()
    for _ in range(1):
        direction = rng.standard_normal(len(theta))
        slope = dense @ direction
        expected = differences(problem, parameters, theta, direction)
        assert np.abs(expected - slope).max() < 1e-7 * np.abs(slope).max()
