"""Contracts hold for all weights: values and derivatives by AD, in torch, casadi and numpy."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
import pytest
import torch

from gbspec.backends.module import generate, load_module
from gbspec.diagnostics import Findings
from gbspec.ir.model import Contract, Model
from gbspec.passes.contracts import with_contracts
from tests import texts
from tests.contracts.helpers import bound, model_of, points, weights

PLAIN = [
    ">= 0",
    "in [0, 5]",
    "<= 2",
    "in [-K, K]",
    "in [v, v + 1], increasing in v",
    ">= v^2",
    "increasing in u",
    "decreasing in u, increasing in v",
    "zero at u = 0",
    "zero at u = 0, zero at v = 1",
    ">= 0, zero at u = 0",
    ">= 0, zero at u = 0, zero at v = 1",
    "zero at u = 0, increasing in u",
    "zero at u = 1, decreasing in u",
    "zero at u = K, increasing in u, decreasing in v",
    "zero at u = 1 + v^2, increasing in u",
    "zero at u = 0, decreasing in v",
    ">= 0, zero at u = 0, increasing in u, decreasing in v",
    "in [0, 3], zero at u = 0, increasing in u, decreasing in v",
    "in [-2, 3], zero at u = 0, increasing in u, decreasing in v",
    "in [-2, 3], zero at u = 0, increasing in u",
    "<= 3, zero at u = 0, increasing in u",
    ">= -3, zero at u = 0, increasing in u",
    "<= 0, zero at u = 0, increasing in u",
    ">= 0, zero at u = 0, zero at v = 1, increasing in u, increasing in v",
    ">= 0, zero at w = 0, increasing in u, decreasing in v",
    ">= -k, zero at u = 0, decreasing in v",
]

POSTULATED = [
    ">= 0 = u/(K + u) + nn",
    ">= 0, increasing in u = u/(K + u) + nn",
    ">= 0, increasing in u = u/(K + u) - 2*nn",
    "<= 0, decreasing in u = -u/(K + u) + nn",
    ">= -1, increasing in u, decreasing in v = (u/(K + u) - 1)*nn",
    "in [0, 1], increasing in u, zero at u = 0 = u/(K + u)*nn",
    "in [0, 1], increasing in u = u/(K + u) + nn",
    ">= 0, zero at u = 0, increasing in u, decreasing in v = u/(K + u)*nn",
    "<= 0, decreasing in u = -u/(K + u)*nn",
    ">= 0, zero at u = 0, increasing in u = u/(K + u)*exp(2*tanh(nn))",
    "zero at u = 0, increasing in u = k*u + nn",
    ">= 0, decreasing in v = k*exp(-tanh(u))*nn",
    ">= 0, zero at u = 0 = u/(K + u + u^2/k)*nn",
    "increasing in u = log(1 + u)*(2 + tanh(nn))",
]


SHAPED = [
    "(u) convex in u",
    "(u, v) convex in u, increasing in v, >= K",
    "(u, v, w) concave in u, increasing in u, concave in w",
    "(u, v) convex in u, decreasing in u, zero at v = 1, >= 0",
    "(u in [0, 10]) concave in u, increasing in u, zero at u = 0, >= 0",
    "(u in [0, 10]) concave in u, increasing in u, zero at u = 0, in [0, 3]",
    "(u, v) convex in u, zero at u = K, >= -2",
    "(u) odd in u",
    "(u, v) odd in u, increasing in u, zero at v = 2, in [-2, 3]",
    "(u, v) odd in u, odd in v",
    "(u, v) even in u, even in v, >= 0",
    "(u) even in u, convex in u, zero at u = 0, >= 0",
    "(u, v) even in u, zero at u = 1, >= 0, decreasing in v",
    "(u) even in u, zero at u = 2",
    "(u) period 24 in u, >= 0",
    "(u, v) period 24 in u, in [0, 1], decreasing in v",
    "(u, v) period 24 in u, period k + 1 in v",
    "(u) period 24 in u, odd in u",
    "(u) period 24 in u, even in u, zero at u = 3, >= 0",
    "(u) period 24 in u, equals 2 at u = 3, >= 0",
    "(u) equals 1 at u = 0, decreasing in u, >= 0",
    "(u in [0, 10], v) equals 1 at u = 0, decreasing in u, >= 0, decreasing in v",
    "(u) equals 1 at u = 0, zero at u = 3, equals K at u = 5",
    "(u, v) equals 1 + v^2 at u = 1, >= 0",
    "(u) odd in u = u*nn",
    "(u) even in u, convex in u = u^2 + nn",
    "(u) period 24 in u, >= 0 = (2 + sin(2*pi*u/24))*nn",
    "(u) equals 3 at u = 0 = 3*exp(tanh(nn))",
]


SPLINES = [
    "(u in [0, 10]) by spline(12)",
    "(u in [0, 10]) >= 0, increasing in u by spline(9)",
    "(u in [0, 10], v in [0, 3]) >= 0, decreasing in v by spline(6, 5)",
    "(u in [0, 10]) increasing in u, zero at u = 0, in [0, 3] by spline(8)",
    "(u in [0, 10]) equals 1 at u = 0, >= 0 by spline(8)",
    "(u in [0, 10]) >= 0 = u/(K + u)*nn by spline(8)",
]


def cases() -> list[str]:
    free = [f"unknown f(u, v, w) {text} by mlp(12, 12)" for text in PLAIN]
    ranged = [f"unknown f(u in [0, 10], v) {text} by mlp(12, 12)" for text in POSTULATED]
    one = [f"unknown f(u) {text} by mlp(8, 8)" for text in PLAIN if "v" not in text and "w" not in text]
    return [
        *free,
        *(f"unknown f{text} by mlp(8, 8)" for text in SHAPED),
        *ranged,
        *one,
        *(f"unknown f{text}" for text in SPLINES),
        "unknown f(u in [-5, 5], v) >= 0, zero at u = 0, decreasing in v by mlp(9)",
        "unknown f(u in [0, 5], v) zero at u = 0, increasing in u by mlp(9, 5)",
        "unknown f(u in [0, 5], v) zero at u = 5, increasing in u by mlp(9, 5)",
        "unknown f, g(u, v) f >= 0, f increasing in u, g decreasing in u, g in [0, 1] by mlp(12, 12)",
        "unknown f, g(u, v) >= 0, zero at u = 0, f increasing in u, g increasing in v by mlp(12, 12)",
        "unknown f, g(u, v) f zero at u = 0, f increasing in u by mlp(12, 12)",
    ]


def raw_size(instance: Any, network: int, x: np.ndarray) -> float:
    """The largest raw output of a network at points [B, arguments], on the scale of the function."""
    call = instance.numpy_networks()[network]
    return float(np.abs(np.array(call(*x.T))).max() * max(call.scale))


def check_values(model: Model, instance: Any, x: torch.Tensor) -> None:
    """Asserts every contract of every output at the points, by torch, with finite values and gradients."""
    for unknown in model.unknowns:
        names = [a.name for a in model.networks[unknown.network].arguments]
        function = instance.functions[unknown.name]
        x = x.detach().clone().requires_grad_()
        y = function(x if len(names) > 1 else x[:, 0])
        (slope,) = torch.autograd.grad(y.sum(), x)
        assert torch.isfinite(y).all()
        assert torch.isfinite(slope).all()
        value, constants = y.detach().numpy(), instance.weights["constants"]
        size = 1e-13 * (1 + np.abs(value).max())
        for contract in unknown.contracts:
            at = None
            if contract.value is not None:
                at = bound(contract.value, model, unknown.network, x, constants)
                size = 1e-13 * (1 + np.abs(value).max() + np.abs(at).max())
            match contract.kind:
                case "convex" | "concave" | "odd" | "even" | "period" | "equals":
                    check_shape(contract, function, x.detach(), names, at, model, unknown.network, constants)
                case "lower":
                    assert (value - at).min() >= -size
                case "upper":
                    assert (at - value).min() >= -size
                case "increasing" | "decreasing":
                    sign = 1 if contract.kind == "increasing" else -1
                    derivative = sign * slope[:, names.index(str(contract.argument))].numpy()
                    assert derivative.min() >= -1e-13 * (1 + np.abs(derivative).max())
                case "zero":
                    there = x.detach().clone()
                    there[:, names.index(str(contract.argument))] = torch.tensor(at)
                    left = function(there if len(names) > 1 else there[:, 0]).detach().abs()
                    # The argument of the zero is rounded, here and in the module, and so are raw outputs, of which a
                    # difference vanishes there.
                    raw = raw_size(instance, unknown.network, there.numpy())
                    assert left.max() <= 10 * size + 1e-13 * (slope.abs().max() * np.abs(at).max() + raw)


def check_shape(
    contract: Contract,
    function: Any,
    x: torch.Tensor,
    names: list[str],
    at: Any,
    model: Model,
    network: int,
    constants: Any,
) -> None:
    """Asserts a curvature (by the values in the middle of two points), a symmetry, a period, or a value."""
    i = names.index(str(contract.argument))
    v = x[:, i]

    def value(there: torch.Tensor) -> torch.Tensor:
        moved = x.clone()
        moved[:, i] = there
        return function(moved if len(names) > 1 else moved[:, 0]).detach()

    here = value(v)
    size = 1e-12 * (1 + float(here.abs().max()))
    match contract.kind:
        case "convex" | "concave":
            other = v.flip(0)
            middle, mean = value((v + other) / 2), (here + value(other)) / 2
            gap = mean - middle if contract.kind == "convex" else middle - mean
            assert gap.min() >= -size - 1e-12 * float(value(other).abs().max())
        case "odd" | "even":
            sign = 1 if contract.kind == "even" else -1
            assert (value(-v) - sign * here).abs().max() <= size
        case "period":
            near = v.clamp(-100, 100)  # a shift by a period is rounded where it is small beside the argument
            slope = torch.autograd.functional.jvp(value_with_slope(function, x, i), near, torch.ones_like(near))[1]
            left = value(near + torch.tensor(at)) - value(near)
            assert left.abs().max() <= 10 * size + 1e-11 * float(slope.abs().max())
        case "equals":
            assert contract.to is not None
            # One point after the other: libraries add up the terms of several points in another order, which matters
            # where weights are so large that these terms cancel.
            moved = x.clone()
            moved[:, i] = torch.tensor(at)
            there = [float(function(row if x.shape[1] > 1 else row[0]).detach()) for row in moved]
            reached = bound(contract.to, model, network, x, constants)
            assert np.abs(np.array(there) - reached).max() <= 100 * size * (1 + np.abs(reached).max())


def value_with_slope(function: Any, x: torch.Tensor, i: int) -> Any:
    """The function of one argument, the others as they are at the points."""

    def value(v: torch.Tensor) -> torch.Tensor:
        moved = torch.cat([x[:, :i], v[:, None], x[:, i + 1 :]], 1)
        return function(moved if x.shape[1] > 1 else v)

    return value


def check_agreement(model: Model, instance: Any, x: torch.Tensor) -> None:
    """Asserts that values (torch, casadi, numpy) and derivatives (torch, casadi) agree, to 1e-12 of the largest."""
    for unknown in model.unknowns:
        x = x.detach().clone().requires_grad_()
        y = instance.functions[unknown.name](x if x.shape[1] > 1 else x[:, 0])
        (slope,) = torch.autograd.grad(y.sum(), x)
        function = instance.casadi_function(unknown.name)
        argument = casadi.MX.sym("a", x.shape[1])
        both = casadi.Function("both", [argument], [function(argument), casadi.jacobian(function(argument), argument)])
        value, jacobian = both.map(len(x))(x.detach().numpy().T)
        jacobian = np.asarray(jacobian).reshape(len(x), -1)
        arithmetic = instance.arithmetic("numpy")
        _, output, method = instance.equations.unknowns[unknown.name]
        by_numpy = method(
            arithmetic, tuple(instance.weights["constants"]), instance.numpy_networks(), *x.detach().numpy().T
        )[output]
        for found, expected in (
            (np.asarray(value).ravel(), y.detach().numpy()),
            (by_numpy, y.detach().numpy()),
            (jacobian, slope.numpy()),
        ):
            np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12 * (1 + np.abs(expected).max()))


@pytest.mark.parametrize("text", cases())
def test_contracts_hold_for_every_weight(text: str) -> None:
    model = model_of(text)
    cls = load_module(model)
    for seed in range(6):
        check_values(model, cls(weights(cls, seed)), points(model, 0, 200, seed))
    for kind in ("zero", "huge", "tiny"):
        check_values(model, cls(weights(cls, 0, kind)), points(model, 0, 50, 1))


@pytest.mark.parametrize("text", cases())
def test_libraries_agree(text: str) -> None:
    model = model_of(text)
    cls = load_module(model)
    for seed in range(2):
        instance = cls.random(seed)
        x = points(model, 0, 20, seed)
        check_agreement(model, instance, x.clamp(-20, 20))


def test_steps_between_points_follow_the_direction() -> None:
    """Values at ordered arguments are ordered, also across kinks and in saturation, where derivatives do not tell."""
    model = model_of("unknown f(u, v) >= 0, zero at u = 0, increasing in u, decreasing in v by mlp(12, 12)")
    cls = load_module(model)
    grid = torch.cat([-torch.logspace(3, -3, 200), torch.zeros(1), torch.logspace(-3, 3, 200)]).double()
    for seed in range(5):
        function = cls(weights(cls, seed)).functions["f"]
        for other in (-10.0, 0.0, 3.0):
            y = function(torch.stack([grid, torch.full_like(grid, other)], 1))
            assert (y.diff() >= -1e-13 * (1 + y.abs().max())).all()
            y = function(torch.stack([torch.full_like(grid, abs(other)), grid], 1))
            assert (y.diff() <= 1e-13 * (1 + y.abs().max())).all()


def test_a_pole_weakens_the_guarantee_to_the_ranges() -> None:
    everywhere = model_of("unknown f(u in [0, 10]) >= 0 by mlp(8)").unknowns[0].form
    ranged = model_of("unknown f(u in [0, 10]) >= 0 = u/(K + u)*nn by mlp(8)").unknowns[0].form
    assert everywhere is not None and everywhere.scope == "everywhere"
    assert ranged is not None and ranged.scope == "ranges" and ranged.within == ("u",)


def test_the_value_at_a_zero_is_that_of_a_single_point() -> None:
    text = "model m\nstate x in [0, 3]\nunknown f(x) increasing in x, zero at x = 1 by mlp(4)\nx' = f\nobserve x\n"
    assert "(raw_f_there,) = network(1)\n" in generate(with_contracts(texts.model_of(text), Findings()))
