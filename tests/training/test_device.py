"""The torch graph works on the device that it is told: on a GPU where there is one, else on one without values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gbspec.diagnostics import UserError
from gbspec.training import TrainOptions, train
from gbspec.training.engines.columns import Columns
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.engines.torch.jacobian import jacobian
from tests.training.conftest import EVERYTHING, URP, everything_data, model_of, problem_of, urp_data
from tests.training.reference import linearise, unroll

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")
MODELS = {
    "reactor": (URP, urp_data(4, 2.0, 6), 0.1),
    "everything": (EVERYTHING, everything_data(), 0.3),
}


@pytest.mark.parametrize("name", MODELS)
def test_no_tensor_of_the_graph_ignores_the_device(name: str) -> None:
    """Tensors of the device `meta` have no values, and to mix them with others is an error, as with those of a GPU."""
    with pytest.raises((RuntimeError, NotImplementedError)):
        torch.ones(2, device="meta") + torch.ones(2)
    text, data, max_step = MODELS[name]
    problem, parameters, theta = problem_of(model_of(text), data, max_step)
    vector = torch.from_numpy(theta).to("meta").requires_grad_()
    solution = unroll(problem, parameters, vector, "meta")
    (gradient,) = torch.autograd.grad((solution.residuals**2).sum(), vector)
    assert {part.device.type for part in (solution.before, solution.after, solution.residuals)} == {"meta"}
    assert (gradient.device.type, gradient.shape) == ("meta", vector.shape)
    engine = TorchEngine(problem, parameters)
    path = engine.plan(theta)
    moments, columns = engine.moments(theta, path), Columns(problem, parameters, theta, False, "meta")
    found = jacobian(columns, path, moments, columns.observed(moments.before, problem.factor))
    assert {part.device.type for part in (found.shared, found.local, found.owner)} == {"meta"}
    assert found.shared.shape == (int(problem.seen.sum()), parameters.n_shared)


@needs_gpu
@pytest.mark.parametrize("name", MODELS)
def test_a_gpu_gives_the_same_numbers(name: str) -> None:
    text, data, max_step = MODELS[name]
    problem, parameters, theta = problem_of(model_of(text), data, max_step)
    found = [linearise(problem, parameters, theta, device=device) for device in ("cpu", "cuda")]
    for part in ("residuals", "shared", "local", "owner"):
        a, b = (getattr(each, part).numpy() for each in found)
        assert np.allclose(a, b, rtol=1e-10, atol=1e-12), part


@needs_gpu
@pytest.mark.parametrize("method", ["lm", "adam", "lbfgs"])
def test_trains_on_a_gpu(method: str, tmp_path: Path) -> None:
    options: dict[str, Any] = {"method": method, "epochs": 2, "warm_start": False}
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    runs = [train(model, data, TrainOptions(**options, device=device), tmp_path / device) for device in ("cpu", "cuda")]
    losses = [run.fit.members[0].loss for run in runs]
    assert losses[1] == pytest.approx(losses[0], rel=1e-6)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_no_gpu_is_told_before_anything_is_written(tmp_path: Path) -> None:
    model, data = model_of(URP), urp_data(4, 2.0, 6)
    with pytest.raises(UserError, match=r"GB861.*`--device cuda` needs a GPU"):
        train(model, data, TrainOptions(device="cuda"), tmp_path / "run")
    assert not (tmp_path / "run").exists()
