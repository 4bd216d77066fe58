"""`floor`, `ceil` and `mod` at negative numbers too, the same in all backends, with slopes of 0 but for `mod`."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gbspec.backends.casadi.evaluator import Evaluator
from gbspec.backends.module import load_module
from gbspec.diagnostics import Findings, Source
from gbspec.frontend import load_model
from gbspec.ir import Model

TEXT = """model clock
time t
state x
learn y = 3
x' = floor(x) + 0*y
observe up = ceil(x)
observe left = mod(x, y)
observe below = mod(x, -y)
observe day = if(mod(t, 24) < 8, 1, 0)
"""
POINTS = np.array([-7.5, -7.0, -6.0, -0.25, 0.0, 0.5, 3.0, 6.0, 7.5, 1e15])
TIMES = np.array([0.0, 7.999, 8.0, 23.0, 24.0, 31.0, 32.0, -1.0, -20.0, 241.0])


def model_of(text: str) -> Model:
    return load_model("model.gb", Findings(), lambda path: Source(str(path), text))


def known(x: float, t: float) -> list[float]:
    """What the channels are, by Python's own functions."""
    return [math.ceil(x), x % 3.0, x % -3.0, float(t % 24 < 8)]


@pytest.fixture(scope="module")
def instance() -> object:
    return load_module(model_of(TEXT))({"constants": np.array([3.0])})


def test_values_in_every_library(instance: object) -> None:
    evaluator, m = Evaluator(instance), instance.arithmetic("numpy")  # type: ignore[arg-type,attr-defined]
    wanted = np.array([known(x, t) for x, t in zip(POINTS, TIMES, strict=True)])
    x, t = POINTS[:, None], TIMES
    found = instance.observe(torch.tensor(t), torch.tensor(x)).numpy()  # type: ignore[attr-defined]
    np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(evaluator.observe_many(t, x, np.zeros((10, 0)), np.zeros((10, 0))), wanted)
    given = (np.zeros((10, 0)), np.zeros((10, 0)), (np.float64(3.0),), ())
    np.testing.assert_array_equal(instance.equations.observe(m, t, x, *given), wanted)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(instance.equations.rhs(m, t, x, *given), np.floor(x))  # type: ignore[attr-defined]


def test_slopes(instance: object) -> None:
    """Those of `mod(x, y)` are 1, and minus the number of times that y is taken away."""
    x = torch.tensor([[-7.5], [7.5]], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([[3.0], [3.0]], dtype=torch.float64, requires_grad=True)
    equations, m = instance.equations, instance.arithmetic("torch")  # type: ignore[attr-defined]
    none = torch.zeros((2, 0), dtype=torch.float64)
    channels = equations.observe(m, torch.zeros(2), x, none, none, (y[:, 0],), ())
    for i, slopes in enumerate([((0.0, 0.0), (0.0, 0.0)), ((1.0, 1.0), (3.0, -2.0)), ((1.0, 1.0), (2.0, -3.0))]):
        for of, slope in zip((x, y), slopes, strict=True):
            (found,) = torch.autograd.grad(channels[:, i].sum(), of, retain_graph=True, allow_unused=True)
            assert (torch.zeros(2) if found is None else found[:, 0]).tolist() == list(slope), (i, of)


@pytest.mark.parametrize("text", ["floor(-1.5)", "ceil(-1.5)", "mod(-7, 3)", "mod(7, -3)", "mod(8, 0.1)"])
def test_constants_are_what_equations_compute(text: str) -> None:
    model = model_of(f"model m\nstate x\nconst a = {text}\nlearn b = 1\nx' = -x\nobserve y = {text}*b\n")
    instance = load_module(model)()
    assert model.constants[0].value == float(instance.observe(0.0, [1.0])[0])
