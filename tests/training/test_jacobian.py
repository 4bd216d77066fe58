"""The Jacobian of all residuals is exact: it equals that of automatic differentiation through the whole unroll."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gbspec.training.engines.columns import starts_of_data
from gbspec.training.problem.forcing import Forcing
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data
from tests.training.reference import linearise, measured_residuals, solve, unroll, whole_jacobian


@pytest.mark.parametrize("blend", [1.0, 0.3, 0.0])
@pytest.mark.parametrize("text", [URP, EVERYTHING])
def test_equals_automatic_differentiation(text: str, blend: float) -> None:
    model = model_of(text)
    data = urp_data(3, 2.0, 1) if text == URP else everything_data()
    problem, parameters, theta = problem_of(model, data, 0.13, blend=blend)
    found = linearise(problem, parameters, theta)
    expected = torch.func.jacrev(lambda v: measured_residuals(problem, unroll(problem, parameters, v).residuals))(
        torch.from_numpy(theta)
    )
    dense = whole_jacobian(found, parameters)
    assert dense.shape == expected.shape
    assert float((dense - expected).abs().max()) < 1e-10 * float(expected.abs().max())
    assert np.allclose(found.residuals.numpy(), solve(problem, parameters, theta), rtol=0, atol=1e-13)


def test_equals_finite_differences() -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(), 0.2)
    dense = whole_jacobian(linearise(problem, parameters, theta), parameters).numpy()
    rng = np.random.default_rng(5)
    for _ in range(5):
        direction = rng.standard_normal(len(theta))
        h = 1e-5
        ahead, behind = (solve(problem, parameters, theta + s * h * direction) for s in (1, -1))
        slope = dense @ direction
        assert np.abs((ahead - behind) / (2 * h) - slope).max() < 1e-7 * np.abs(slope).max()


def test_imputed_forcing_and_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Resets of every state at every row, with the segments in many chunks."""
    monkeypatch.setattr("gbspec.training.engines.torch.jacobian.CHUNK_BYTES", 20_000)
    problem, parameters, theta = problem_of(model_of(URP), urp_data(4, 2.0, 1), 0.1)
    rng = np.random.default_rng(0)
    shape = problem.forcing.value.shape
    forced = replace(problem, forcing=Forcing(rng.uniform(0.3, 0.7, shape), rng.uniform(0, 1, shape)))
    expected = torch.func.jacrev(lambda v: measured_residuals(forced, unroll(forced, parameters, v).residuals))(
        torch.from_numpy(theta)
    )
    dense = whole_jacobian(linearise(forced, parameters, theta), parameters)
    assert float((dense - expected).abs().max()) < 1e-10 * float(expected.abs().max())


def test_local_columns_alone() -> None:
    problem, parameters, theta = problem_of(model_of(EVERYTHING), everything_data(), 0.2)
    whole = linearise(problem, parameters, theta)
    local = linearise(problem, parameters, theta, only_local=True)
    assert local.shared.shape[1] == 0
    assert torch.allclose(local.local, whole.local, rtol=1e-12, atol=1e-13)


def test_a_blow_up_is_told_by_its_residuals() -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(2, 2.0, 1), 0.1)
    theta[: parameters.n_weights] *= 1e6
    found = linearise(problem, parameters, theta)
    assert not bool(torch.isfinite(found.residuals).all())
    assert found.shared.numel() == 0


@pytest.mark.parametrize(("start", "known"), [("2*dose", True), ("2*s", False)])
def test_starts_that_no_learned_constant_moves_need_no_graph(start: str, known: bool) -> None:
    model = model_of(f"""model starts
condition dose = 1
state A
learn s = 1 in [0.1, 10]
A' = -s*A
initial A = {start}
observe A
""")
    assert all(starts_of_data(model)) is known
