"""Steps of learned initial states along which the data say nothing."""

from __future__ import annotations

import numpy as np

from gbspec.training.starts.initial_states import damped_steps


def test_a_flat_direction_is_left_alone() -> None:
    """Two states of which only the sum matters: a damping that has all but vanished leaves the equations regular."""
    hessian = np.ones((2, 2, 2)) * np.array([1.0, 1e6])[:, None, None]
    gradient = np.array([[2.0, 2.0], [2e6, 2e6]])
    steps = damped_steps(hessian, gradient, np.full(2, 1e-30))
    assert np.allclose(steps, -1.0, rtol=1e-3)


def test_nothing_measured_moves_nothing() -> None:
    assert np.array_equal(damped_steps(np.zeros((1, 2, 2)), np.zeros((1, 2)), np.zeros(1)), np.zeros((1, 2)))
