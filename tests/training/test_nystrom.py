"""Damped steps through a sketch are those through factored matrices."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.training.optimise import normal_equations, nystrom
from gbspec.training.optimise.normal_equations import NormalEquations
from gbspec.training.optimise.nystrom import Blocks, Sketch, TooSlowError
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data
from tests.training.reference import linearise


@pytest.mark.parametrize("text", [URP, EVERYTHING])
@pytest.mark.parametrize("ridge", [0.0, 1e-3])
def test_steps_equal_those_of_factored_matrices(text: str, ridge: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """With starts and constants of each trajectory, a ridge, and weights of residuals."""
    problem, parameters, theta = problem_of(
        model_of(text), urp_data(6, 5.0, 1) if text == URP else everything_data(), 0.2
    )
    weights = np.random.default_rng(1).uniform(0.5, 1.0, len(linearise(problem, parameters, theta).residuals))

    def equations() -> NormalEquations:
        return NormalEquations(linearise(problem, parameters, theta), parameters, weights, ridge, theta)

    factored = equations()
    assert factored.sketch is None
    monkeypatch.setattr(normal_equations, "LEAST", 1)
    monkeypatch.setattr(nystrom, "SHARE", 1.0)
    monkeypatch.setattr(nystrom, "FIRST_RANK", 8)
    sketched = equations()
    for damping in (1.0, 1e-2, 1e-4):
        one, other = sketched.step(damping), factored.step(damping)
        assert np.linalg.norm(one - other) < 1e-7 * np.linalg.norm(other)
        vector = np.random.default_rng(2).standard_normal(parameters.size)
        one, other = sketched.invert(vector, damping), factored.invert(vector, damping)
        assert np.linalg.norm(one - other) < 1e-7 * np.linalg.norm(other)
    for damping in (1e-2, 1e-4):
        found = sketched.degrees_of_freedom(damping, 3)
        assert found == pytest.approx(factored.degrees_of_freedom(damping, 3), rel=1e-6)
    assert sketched.sketch is not None


@pytest.mark.parametrize("ridges", [(0.0, 1e-3), (1e-3, 0.0), (1e-3, 2e-3)])
def test_another_ridge_gives_what_new_equations_give(ridges: tuple[float, float]) -> None:
    """With fewer residuals than weights: what is kept between calls does not depend on the ridge before."""
    problem, parameters, theta = problem_of(model_of(URP), urp_data(6, 5.0, 1), 0.2)

    def equations(ridge: float) -> NormalEquations:
        system = linearise(problem, parameters, theta)
        return NormalEquations(system, parameters, np.ones(len(system.residuals)), ridge, theta)

    changed = equations(ridges[0])
    assert changed.dual
    changed.step(1e-2)
    changed.ridge = ridges[1]
    expected = equations(ridges[1])
    np.testing.assert_allclose(changed.step(1e-2), expected.step(1e-2), rtol=1e-9, atol=1e-12)
    assert changed.degrees_of_freedom(1e-2, 0) == pytest.approx(expected.degrees_of_freedom(1e-2, 0), rel=1e-9)


def test_factored_matrices_serve_where_the_sketch_does_not_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(6, 5.0, 1), 0.2)
    system = linearise(problem, parameters, theta)
    ones = np.ones(len(system.residuals))
    expected = NormalEquations(system, parameters, ones, 0.0, theta).step(1e-2)
    monkeypatch.setattr(normal_equations, "LEAST", 1)
    monkeypatch.setattr(nystrom, "SHARE", 0.0)
    equations = NormalEquations(system, parameters, ones, 0.0, theta)
    assert np.array_equal(equations.step(1e-2), expected)
    assert equations.sketch is None


@pytest.mark.parametrize("damping", [1e-12, 3e-12, 1e-2])
def test_what_is_returned_is_a_solution(damping: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """At dampings near rounding the recurrence of conjugate gradients drifts away from the true residual."""
    monkeypatch.setattr(nystrom, "FIRST_RANK", 70)
    rng = np.random.default_rng(4)
    q, _ = np.linalg.qr(rng.standard_normal((300, 300)))
    shared = np.sqrt(1e4 * 0.64 ** np.arange(300))[:, None] * q
    nothing = Blocks.of(np.zeros((300, 1)), np.zeros(300, dtype=np.int64), 1)
    right = np.append(shared.T @ rng.standard_normal(300), 0.0)
    try:
        x = Sketch(shared, nothing).solve(right, np.full(301, damping))
    except TooSlowError:
        assert damping < 1e-6
        return
    left = shared.T @ (shared @ x[:300]) + damping * x[:300]
    assert np.linalg.norm(left - right[:300]) < 1e-5 * np.linalg.norm(right)


def test_collinear_columns_of_a_trajectory_are_no_defect() -> None:
    own = np.ones((50, 2)) * 1e3
    blocks = Blocks.of(own, np.zeros(50, dtype=np.int64), 1)
    with pytest.raises(TooSlowError):
        Sketch(np.random.default_rng(0).standard_normal((50, 4)), blocks).solve(np.ones(6), np.full(6, 1e-14))


def test_a_spectrum_that_does_not_fall_is_left_to_factored_matrices() -> None:
    rng = np.random.default_rng(0)
    nothing = Blocks.of(np.zeros((400, 1)), np.zeros(400, dtype=np.int64), 1)
    with pytest.raises(TooSlowError):
        Sketch(rng.standard_normal((400, 300)), nothing).solve(rng.standard_normal(301), np.full(301, 1e-6))
