"""Characteristic roots and Hopf points of models with delays, beside those known from formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import lambertw

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.systems.roots import characteristic_modes
from gbspec.analysis.systems.steady import steady_states
from gbspec.analysis.systems.system import system_of
from gbspec.backends import Evaluator, load_module
from tests.training.conftest import model_of

LINEAR = "model m\ntime t from 0\nstate x in [0, 3]\nlearn k = 1 in [0.5, 3]\nconst tau = 1\n"


def test_roots_of_one_delay_are_branches_of_lamberts_function() -> None:
    """x' = -k x(t - tau) has the roots W_j(-k tau)/tau."""
    values, vectors = characteristic_modes(np.zeros((1, 1)), [np.full((1, 1), -1.3)], np.array([0.7]))
    known = np.array([lambertw(-1.3 * 0.7, j) / 0.7 for j in range(-4, 4)])
    assert np.allclose(np.sort_complex(values), np.sort_complex(known), atol=1e-7)
    assert np.allclose(np.abs(vectors), 1.0)


def test_several_delays_and_states() -> None:
    rng = np.random.default_rng(1)
    now, late, lags = rng.normal(size=(2, 2)), [rng.normal(size=(2, 2)) for _ in range(2)], np.array([0.4, 1.1])
    values, vectors = characteristic_modes(now, late, lags)
    for value, vector in zip(values, vectors.T, strict=True):
        matrix = now + sum(m * np.exp(-value * lag) for m, lag in zip(late, lags, strict=True))
        assert np.allclose(matrix @ vector, value * vector, atol=1e-6)


def test_the_hopf_point_of_hutchinsons_equation() -> None:
    """x' = k x (1 - x(t - 1)): the steady state 1 loses its stability at k = pi/2, with frequency pi/2."""
    model = model_of(LINEAR + "x' = k*x*(1 - delay(x, tau))\nobserve x")
    system = system_of(Evaluator(load_module(model)()), model)
    found = [one for one in steady_states(system) if one.state[0] > 0.5]
    assert len(found) == 1 and found[0].stable and np.isclose(found[0].state[0], 1.0)
    assert np.isclose(found[0].eigenvalues[0], lambertw(-1.0), atol=1e-9)
    diagram = bifurcate(system, "k", 0.5, 3.0, BifurcationOptions(values=5, starts=8))
    (hopf,) = [one for one in diagram.special if one.kind == "hopf"]
    assert hopf.value == pytest.approx(np.pi / 2, abs=1e-7)
    assert hopf.frequency == pytest.approx(np.pi / 2, abs=1e-6)
    assert not diagram.cycles
