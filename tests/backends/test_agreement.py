"""Right-hand side, observations, initial values, Jacobian and a step agree in torch, casadi, numpy and symbolically."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.casadi.steps import Stepper, plan
from gbspec.backends.casadi.timeline import Segment
from gbspec.backends.module import load_module
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings
from gbspec.frontend import load_model
from gbspec.ir.methods import METHODS, RK4, STIFF, Method
from gbspec.ir.model import Model
from tests.backends.truth import Truth
from tests.strategies import Point, models, point

Array = NDArray[np.float64]

RANDOM = settings(
    max_examples=12,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    phases=(Phase.explicit, Phase.reuse, Phase.generate, Phase.shrink),
)


def close(value: Any, truth: Any, what: str) -> None:
    """Asserts agreement to 1e-12 of the vector's largest entry (or of 1)."""
    found, wanted = np.asarray(value, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    assert found.shape == wanted.shape, what
    assert np.all(np.isfinite(wanted)), f"{what}: the truth {wanted} is not finite"
    assert np.max(np.abs(found - wanted), initial=0.0) <= 1e-12 * max(1.0, np.max(np.abs(wanted), initial=0.0)), (
        f"{what}: {found} is not {wanted}"
    )


def instance_of(model: Model, seed: int, constants: Array, method: Method = RK4) -> Any:
    """A module with random weights and scales."""
    cls = load_module(model, method)
    weights = cls.random(seed).weights if model.networks else {}
    generator = np.random.default_rng(seed)
    for name, value in weights.items():
        if name.endswith("_scale"):
            weights[name] = generator.uniform(0.5, 2.0, value.shape)
        elif name.endswith("_center"):
            weights[name] = generator.uniform(-1.0, 1.0, value.shape)
    return cls({**weights, "constants": constants})


def check_agreement(model: Model, at: Point, seed: int) -> None:
    instance = instance_of(model, seed, at.constants)
    truth = Truth(model, instance.weights)
    m, networks = instance.arithmetic("numpy"), instance.numpy_networks()
    known = (at.condition, at.inputs, tuple(map(np.float64, at.constants)), networks)
    evaluator = Evaluator(instance)

    rhs = truth.rhs(at)
    with np.errstate(all="ignore"):
        close(instance.equations.rhs(m, at.t, at.x, *known), rhs, "numpy rhs")
        close(instance.equations.observe(m, at.t, at.x, *known), truth.observe(at), "numpy observe")
    close(instance.rhs(at.t, at.x, at.condition, at.inputs), rhs, "torch rhs")
    close(evaluator.rhs_many(at.t, at.x, at.condition, at.inputs)[0], rhs, "casadi rhs")
    close(np.array(instance.casadi_rhs()(at.t, at.x, at.condition, at.inputs)).ravel(), rhs, "casadi rhs, as exported")
    close(instance.observe(at.t, at.x, at.condition, at.inputs), truth.observe(at), "torch observe")
    close(evaluator.observe_many(at.t, at.x, at.condition, at.inputs)[0], truth.observe(at), "casadi observe")
    close(instance.initial(at.x, at.condition), truth.initial(at), "torch initial")
    close(evaluator.initial(at.x, at.condition), truth.initial(at), "numpy initial")


def check_derivatives(model: Model, at: Point, seed: int) -> None:
    instance = instance_of(model, seed, at.constants)
    evaluator = Evaluator(instance)

    def rhs(x: torch.Tensor) -> torch.Tensor:
        result: torch.Tensor = instance.rhs(at.t, x, at.condition, at.inputs)
        return result

    x = torch.tensor(at.x)
    reverse = torch.func.jacrev(rhs)(x)
    close(torch.func.jacfwd(rhs)(x), reverse, "torch's Jacobian, forward and reverse")
    close(evaluator.jacobian_at(at.t, at.x, at.condition, at.inputs), reverse, "casadi's Jacobian")


def check_step(model: Model, at: Point, seed: int, method: Method = RK4) -> None:
    instance, h = instance_of(model, seed, at.constants, method), 0.05
    truth = Truth(model, instance.weights).step(at, h, method)
    close(instance.step(at.t, at.x, h, at.condition, at.inputs), truth, "torch step")
    if model.delays:  # steps of a whole solution look at the one before
        return
    segment = Segment(at.t, at.t + h, at.inputs, np.zeros_like(at.inputs), np.zeros_like(at.x))
    steps = plan(at.t, np.array([segment.end]), [segment], h, len(at.x), len(at.inputs), method)
    close(Stepper(instance).run(at.x, steps, at.condition, at.constants)[0], truth, "casadi step")


@RANDOM
@given(models(), st.integers(0, 2**16), st.sampled_from(tuple(METHODS)))
def test_random_models_agree(model: Model, seed: int, method: str) -> None:
    """One model for all comparisons: to make a random one takes as long as to compare it."""
    at = point(model, seed)
    check_agreement(model, at, seed)
    check_derivatives(model, at, seed)
    check_step(model, at, seed, METHODS[method])


@pytest.mark.parametrize("name", sorted(set(shipped_models()) - {"buffered_tank"}))  # see tests/algebraic
def test_bundled_models_agree(name: str) -> None:
    model = load_model(shipped_models()[name], Findings())
    at = _plausible(model)
    check_agreement(model, at, 3)
    check_derivatives(model, at, 3)
    for method in (RK4, STIFF):  # random models and tests/backends/test_methods.py take all of them
        check_step(model, at, 3, method)


def _plausible(model: Model) -> Point:
    """A random point inside the declared ranges, with constants at their values and starting values."""
    generator = np.random.default_rng(7)

    def inside(item: Any) -> float:
        low, high = (0.5, 1.5) if item.range is None or not item.range.bounded else (item.range.low, item.range.high)
        return float(low + (high - low) * generator.uniform(0.2, 0.8))

    values = [*(c.value for c in model.constants), *(k.start for k in model.learnables)]
    return Point(
        0.3,
        np.array([inside(state) for state in model.states]),
        np.array([inside(condition) for condition in model.conditions]),
        np.array([*(inside(item) for item in model.inputs), *generator.uniform(0.5, 1.0, len(model.delays))]),
        np.array(values, dtype=np.float64),
    )


@settings(RANDOM, max_examples=6)
@given(models(), st.integers(0, 2**16))
def test_batches_agree_with_single_points(model: Model, seed: int) -> None:
    instance = instance_of(model, seed, point(model, seed).constants)
    points = [point(model, seed + i) for i in range(6)]
    shape = (2, 3, -1)

    def stack(field: str) -> Array:
        return np.array([getattr(p, field) for p in points]).reshape(shape if field != "t" else (2, 3))

    batch = instance.rhs(stack("t"), stack("x"), *(stack(f) if n else None for f, n in _sizes(model)))
    single = [instance.rhs(p.t, p.x, p.condition, p.inputs) for p in points]
    close(batch.reshape(6, -1), torch.stack(single), "a batch of two axes")


def _sizes(model: Model) -> list[tuple[str, int]]:
    return [("condition", len(model.conditions)), ("inputs", len(model.inputs))]
