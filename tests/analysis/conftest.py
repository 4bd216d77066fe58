from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir.model import Model
from gbspec.runs.record import DataRecord, FitRecord, MemberRecord
from gbspec.runs.store import Run, open_run


def model_of(name: str) -> Model:
    """A shipped model."""
    return load_model(name, Findings())


def nearly_true(constants: dict[str, float] | None = None, width: int = 64, seed: int = 0) -> Any:
    """An instance of urp_gb2 whose network is fitted to the true rate by linear least squares on its last layer.

    Hidden layers are random; the rate is met to about 1 % over the region that the cycles visit.
    """
    module = load_module(model_of("urp_gb2"))
    instance = module.random(seed)
    weights = dict(instance.weights)
    generator = np.random.default_rng(seed)
    low, high = np.array([0.2, 0.4, 0.2]), np.array([0.97, 3.75, 0.5])
    weights["network.phi.input_center"], weights["network.phi.input_scale"] = (low + high) / 2, (high - low) / 2
    weights["network.phi.input_low"], weights["network.phi.input_high"] = low, high
    weights["network.phi.0.weight"] = generator.normal(0.0, 0.2, (width, 3))
    weights["network.phi.0.bias"] = generator.uniform(-0.2, 0.2, width)
    weights["network.phi.1.weight"] = generator.normal(0.0, 2.0 / width**0.5, (width, width))
    weights["network.phi.1.bias"] = generator.uniform(-1.0, 1.0, width)
    points = low + (high - low) * generator.random((6000, 3))
    rate = points[:, 2] * (1.0 - points[:, 0]) * np.exp(points[:, 1])

    def silu(z: np.ndarray) -> np.ndarray:
        return z / (1.0 + np.exp(-z))

    a = (points - weights["network.phi.input_center"]) / weights["network.phi.input_scale"]
    for layer in (0, 1):
        a = silu(a @ weights[f"network.phi.{layer}.weight"].T + weights[f"network.phi.{layer}.bias"])
    # Where the rate is small the cycle spends most of its time, so errors count relative to it.
    importance = 1.0 / (0.3 + rate)
    design = np.column_stack([a, np.ones(len(a))]) * importance[:, None]
    solution = np.linalg.lstsq(design, rate * importance, rcond=1e-13)[0]
    weights["network.phi.2.weight"], weights["network.phi.2.bias"] = solution[None, :-1], solution[-1:]
    weights["network.phi.output_center"], weights["network.phi.output_scale"] = np.zeros(1), np.ones(1)
    values = {"B": 11.0, "beta": 3.0, **(constants or {})}
    weights["constants"] = np.array([values[name] for name in module.constants])
    return module(weights, {"max_step": 0.1})


@pytest.fixture(scope="session")
def urp_instance() -> Any:
    return nearly_true()


@pytest.fixture
def write_run(tmp_path: Path) -> Callable[..., Run]:
    """Writes a run directory of instances of one model and opens it."""

    def write(model: Model, *instances: Any) -> Run:
        directory = tmp_path / "run"
        for k, instance in enumerate(instances):
            folder = directory / "members" / str(k)
            folder.mkdir(parents=True)
            instance.save(folder / "weights.safetensors")
        (directory / "model.gb").write_text(model.text, encoding="utf-8")
        members = tuple(MemberRecord(k, 1.0, {}, 0.0, ()) for k in range(len(instances)))
        FitRecord("0", model.name, DataRecord("", "", 0, 0, 0), {}, {}, {}, {}, members, ()).write(directory)
        return open_run(directory)

    return write


@pytest.fixture(scope="session")
def urp_evaluator(urp_instance: Any) -> Evaluator:
    return Evaluator(urp_instance)
