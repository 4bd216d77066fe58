"""Damped steps through a sketch are those through factored matrices."""

from __future__ import annotations

import numpy as np
import pytest

from gbspec.training import levenberg, sketch
from gbspec.training.jacobian import linearise
from gbspec.training.levenberg import NormalEquations
from gbspec.training.sketch import Blocks, Sketch, TooSlowError
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data


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
    monkeypatch.setattr(levenberg, "LEAST", 1)
    monkeypatch.setattr(sketch, "SHARE", 1.0)
    monkeypatch.setattr(sketch, "FIRST_RANK", 8)
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


def test_a_spectrum_that_does_not_fall_is_left_to_factored_matrices() -> None:
    rng = np.random.default_rng(0)
    nothing = Blocks.of(np.zeros((400, 1)), np.zeros(400, dtype=np.int64), 1)
    with pytest.raises(TooSlowError):
        Sketch(rng.standard_normal((400, 300)), nothing).solve(rng.standard_normal(301), np.full(301, 1e-6))
