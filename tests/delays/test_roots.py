"""Characteristic roots and Hopf points of models with delays, beside those known from formulas."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import lambertw

from gbspec.analysis.bifurcation.bifurcate import BifurcationOptions, bifurcate
from gbspec.analysis.bifurcation.eigen import eigen
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


DELAYED_INPUT = """
model m
time t from 0
input u held
state x in [-10, 10]
learn T = 20 in [2, 200]
learn b = 0 in [-1, 2]
const tau = 24
x' = (-3*delay(u, tau) - x + b*x^3)/T
observe x
"""


def test_a_delay_of_an_input_is_in_no_loop() -> None:
    """At rest such a model is an ordinary one: its eigenvalues are those of the Jacobian, and it can be varied."""
    model = model_of(DELAYED_INPUT)
    system = system_of(Evaluator(load_module(model)()), model).with_values({"u": 0.5})
    assert system.delayed is None
    (point,) = eigen(system, steady=True).points
    assert point.state["x"] == pytest.approx(-1.5)
    assert point.eigenvalues == pytest.approx([-1 / 20])
    diagram = bifurcate(system.with_values({"b": 1 / 3}), "u", -0.6, 0.6, BifurcationOptions(values=5, starts=8))
    assert [one.kind for one in diagram.special] == ["fold", "fold"]
    assert [abs(one.value) for one in diagram.special] == pytest.approx([2 / 9, 2 / 9])


def test_a_delay_between_states_in_no_loop_has_no_roots_of_its_own() -> None:
    now, late = np.diag([-1e4, -2.0]), np.array([[0.0, 0.0], [1.0, 0.0]])
    values, vectors = characteristic_modes(now, [late], np.array([1.0]))
    assert values == pytest.approx([-2.0, -1e4])
    assert np.abs(vectors) == pytest.approx(np.array([[0.0, 0.0], [1.0, 1.0]]), abs=1e-3)
    without, _ = characteristic_modes(now, [0 * late], np.array([1.0]))
    assert without == pytest.approx([-2.0, -1e4])


@pytest.mark.parametrize("strength", [-1.5, -0.3, 1e-3, 1e-8])
def test_every_root_solves_the_characteristic_equation(strength: float) -> None:
    """Also where the delayed term is so weak that eigenvalues of the discretisation lie before the roots."""
    values, _ = characteristic_modes(np.full((1, 1), -0.05), [np.full((1, 1), strength)], np.array([24.0]))
    terms = values + 0.05 - strength * np.exp(-24.0 * values)
    assert np.all(np.abs(terms) < 1e-8 * np.maximum(np.abs(values), 0.05))
    branches = np.array([lambertw(strength * 24 * np.exp(24 * 0.05), j) / 24 - 0.05 for j in range(-40, 41)])
    assert all(np.abs(branches - value).min() < 1e-9 for value in values)
    assert values[0].real == pytest.approx(branches.real.max())
    assert np.sort(values.imag) == pytest.approx(-np.sort(-values.imag)[::-1])
    assert np.sort_complex(values) == pytest.approx(np.sort_complex(values.conj()))


def test_a_pair_is_never_cut_and_multiple_roots_stay() -> None:
    values, _ = characteristic_modes(np.full((1, 1), 0.5), [np.full((1, 1), -1.3)], np.array([1.0]))
    other, _ = characteristic_modes(np.full((1, 1), 0.5), [np.full((1, 1), 1.3)], np.array([1.0]))
    assert len(values) == 8 and len(other) == 9
    for found in (values, other):
        assert np.sort_complex(found) == pytest.approx(np.sort_complex(found.conj()))
    twice, modes = characteristic_modes(np.diag([0.5, 0.5]), [np.diag([-1.3, -1.3])], np.array([1.0]))
    assert twice[:4] == pytest.approx(values[[0, 0, 1, 1]])
    assert np.linalg.matrix_rank(modes[:, :2]) == 2
    double, _ = characteristic_modes(np.zeros((1, 1)), [np.full((1, 1), -np.exp(-1))], np.array([1.0]))
    assert double[:2] == pytest.approx([-1, -1], abs=1e-5)
