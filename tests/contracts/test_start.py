"""How constrained networks begin: at the postulate, and where they can move."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from gbspec.backends.module import load_module
from tests.contracts.helpers import model_of

U = torch.linspace(0.3, 10, 40, dtype=torch.float64)


def silent(cls: Any, center: float, scale: float) -> Any:
    """An instance whose network says nothing: all its last weights give raw outputs of 0."""
    weights = dict(cls.random(0).weights)
    network = cls.networks[0]
    last = len(network["sizes"]) - 2
    weights[f"network.f.{last}.weight"] = np.full_like(weights[f"network.f.{last}.weight"], -1e4)
    weights[f"network.f.{last}.bias"] = np.zeros_like(weights[f"network.f.{last}.bias"])
    if network["layout"] is None:
        weights[f"network.f.{last}.weight"] *= 0
    weights["network.f.output_center"] = np.full_like(weights["network.f.output_center"], center)
    weights["network.f.output_scale"] = np.full_like(weights["network.f.output_scale"], scale)
    return cls(weights)


@pytest.mark.parametrize(
    ("text", "center", "known"),
    [
        (">= 0, increasing in u = u/(K + u)*nn", 1.0, lambda u: u / (1 + u)),
        (">= 0 = u/(K + u) + nn", 0.0, lambda u: u / (1 + u)),
        ("in [0, 2], increasing in u = u/(K + u) + nn", 0.0, lambda u: u / (1 + u)),
        ("in [0, 1], increasing in u = u/(K + u)*nn", 1.0, lambda u: u / (1 + u)),
        (">= 0, increasing in u = u/(K + u)*exp(nn)", 0.0, lambda u: u / (1 + u)),
        (">= -1, decreasing in u = -u/(K + u) + nn", 0.0, lambda u: -u / (1 + u)),
    ],
)
def test_a_silent_network_is_the_postulate(text: str, center: float, known: Any) -> None:
    instance = silent(load_module(model_of(f"unknown f(u in [0, 10]) {text} by mlp(8, 8)")), center, 0.3)
    np.testing.assert_allclose(instance.functions["f"](U).numpy(), known(U).numpy(), rtol=1e-12)


@pytest.mark.parametrize("text", [">= 0", "<= 9", "in [0, 9]", "in [0, 9], increasing in u", "in [-K, 5*k]"])
def test_a_silent_network_is_its_center(text: str) -> None:
    """Bounds leave the center where it is, so the data's mean is where training begins."""
    instance = silent(load_module(model_of(f"unknown f(u) {text} by mlp(8, 8)")), 2.0, 1.0)
    np.testing.assert_allclose(instance.functions["f"](U).numpy(), 2.0, rtol=1e-12)


CASES = [
    ">= 0",
    "in [0, 5]",
    "increasing in u",
    ">= 0, increasing in u, decreasing in v",
    ">= 0, zero at u = 0, increasing in u, decreasing in v",
    ">= 0, zero at u = 0, increasing in u = u/(K + u)*nn",
    "in [0, 1] = u/(K + u) + nn",
]


@pytest.mark.parametrize("text", CASES)
def test_nothing_is_saturated_at_the_start(text: str) -> None:
    """At random starts every layer matters, within four orders of magnitude: no unit is dead, no output flat."""
    cls = load_module(model_of(f"unknown f(u in [0, 10], v in [0, 5]) {text} by mlp(24, 24)"))
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(100, 2, generator=generator, dtype=torch.float64) * torch.tensor([10.0, 5.0])
    for seed in range(3):
        instance = cls.random(seed)
        raw = {name: torch.tensor(value, requires_grad=True) for name, value in instance.weights.items()}
        networks = instance.torch_networks(raw)
        method = instance.equations.unknowns["f"][2]
        out = method(instance.arithmetic("torch"), tuple(raw["constants"]), networks, *x.unbind(1))[0]
        trained = [name for name in raw if name.endswith((".weight", ".bias"))]
        slopes = torch.autograd.grad(out.pow(2).sum(), [raw[name] for name in trained])
        sizes = [float(s.abs().mean()) for s in slopes]
        assert min(sizes) > 1e-4 * max(sizes)
        assert float(out.detach().abs().mean()) < 20
