"""Constrained networks in training: the exact Jacobian, and fits as good as those of plain networks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from gbspec.backends.module import load_module
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.training.options import TrainOptions
from gbspec.training.problem.parameters import Parameters
from gbspec.training.recipe.context import Context, build_context
from tests.contracts.helpers import whole_model
from tests.training.reference import linearise, measured_residuals, unroll, whole_jacobian

GROWTH = """model growth
state S in [0, 10]
state X in [0, 5]
learn Y = 0.5 in [0.1, 1]
unknown mu(S{arguments}) {contracts}
S' = -mu*X/Y
X' = mu*X
observe S
observe X
"""

CONTRACTS = [
    ">= 0, zero at S = 0, increasing in S, decreasing in X by mlp(7, 6)",
    "zero at S = 1, increasing in S by mlp(5)",
    ">= 0, increasing in S = S/(Y + S)*nn by mlp(6, 5)",
    "in [0, 2], increasing in S by mlp(6, 5)",
]


def small_data() -> Trajectories:
    rng = np.random.default_rng(0)
    items = []
    for i in range(3):
        times = np.sort(rng.uniform(0, 3, 5))
        values = np.stack([rng.uniform(1, 8, 5), rng.uniform(0.2, 2, 5)], 1)
        nothing = np.full_like(values, np.nan)
        items.append(Trajectory(str(i), 0.0, times, values, np.ones_like(values), nothing, np.zeros(0)))
    return Trajectories(tuple(items), ("S", "X"))


def problem_of(text: str) -> tuple[Context, Parameters]:
    model = whole_model(text)
    context = build_context(model, load_module(model), small_data(), TrainOptions(max_step=0.4), 0)
    names = ("input_center", "input_scale", "output_center", "output_scale")
    fixed = {name: value for name, value in context.module.weights.items() if name.endswith(names)}
    return context, context.parameters(fixed)


@pytest.mark.parametrize("contracts", CONTRACTS)
def test_the_jacobian_is_exact(contracts: str) -> None:
    """With transformed weights, two evaluations and extra outputs, compared with automatic differentiation."""
    arguments = ", X" if "X" in contracts else ""
    context, parameters = problem_of(GROWTH.format(contracts=contracts, arguments=arguments))
    problem = context.problem()
    theta = parameters.vector(context.module.weights)

    def residuals(vector: Any) -> Any:
        return measured_residuals(problem, unroll(problem, parameters, vector).residuals)

    vector = torch.from_numpy(theta).requires_grad_()
    out = residuals(vector)
    expected = torch.stack([torch.autograd.grad(r, vector, retain_graph=True)[0] for r in out])
    found = linearise(problem, parameters, theta)
    np.testing.assert_allclose(found.residuals.numpy(), out.detach().numpy(), rtol=1e-12, atol=1e-12)
    scale = float(expected.abs().max())
    np.testing.assert_allclose(
        whole_jacobian(found, parameters).numpy(), expected.numpy(), rtol=1e-9, atol=1e-11 * scale
    )


# ---------------------------------------------------------------------- fits
def fitted(unknown: str, truth: Any, ranges: list[tuple[float, float]], iterations: int) -> float:
    """Fits values of a function at random points; the error is relative to the values' standard deviation."""
    places = ", ".join("x" for _ in ranges)
    model = whole_model(f"model m\nstate x\nlearn K = 1 in [0.5, 2]\n{unknown}\nx' = -K*f({places})\nobserve x\n")
    instance = load_module(model).random(0)
    rng = np.random.default_rng(0)
    low, high = np.array(ranges).T
    x, test = (torch.tensor(rng.uniform(low, high, (n, len(ranges)))) for n in (250, 1000))
    y, y_test = truth(*x.unbind(1)), truth(*test.unbind(1))
    weights = {name: torch.tensor(value) for name, value in instance.weights.items()}
    weights["network.f.input_center"], weights["network.f.input_scale"] = x.mean(0), x.std(0)
    if unknown.find("nn") < 0:
        weights["network.f.output_center"][0], weights["network.f.output_scale"][0] = y.mean(), y.std()
    names = [name for name in weights if name.endswith((".weight", ".bias"))]
    sizes = [weights[name].numel() for name in names]
    arithmetic, method = instance.arithmetic("torch"), instance.equations.unknowns["f"][2]

    def predict(vector: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        parts = zip(names, vector.split(sizes), strict=True)
        trained = {name: part.reshape(weights[name].shape) for name, part in parts}
        networks = instance.torch_networks(weights | trained)
        value: torch.Tensor = method(arithmetic, tuple(weights["constants"]), networks, *points.unbind(1))[0]
        return value

    vector = torch.cat([weights[name].ravel() for name in names])
    damping, scale = 1.0, y.std()
    residuals = (predict(vector, x) - y) / scale
    for _ in range(iterations):
        jacobian = _rows(predict, vector, x, scale)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ residuals
        for _ in range(8):
            step = torch.linalg.solve(normal + damping * torch.eye(len(vector), dtype=vector.dtype), -gradient)
            new = (predict(vector + step, x) - y) / scale
            if new @ new < residuals @ residuals:
                vector, residuals, damping = vector + step, new, max(damping / 5, 1e-9)
                break
            damping *= 4
    error = ((predict(vector, test) - y_test) / scale).pow(2).mean().sqrt()
    return float(error)


def _rows(predict: Any, vector: torch.Tensor, x: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    one = torch.func.grad(lambda v, point: predict(v, point[None])[0] / scale)
    rows: torch.Tensor = torch.func.vmap(one, (None, 0))(vector, x)
    return rows


URP = ("Da*(1 - x1)*exp(x2)", lambda x1, x2, da: da * (1 - x1) * torch.exp(x2), [(0, 1), (0, 4), (0.2, 0.5)])
HALDANE = ("", lambda s: s / (0.5 + s + s**2 / 2), [(0, 10)])
MONOD = ("", lambda s, i: s / (0.5 + s) / (1 + i / 2), [(0, 5), (0, 5)])


@pytest.mark.parametrize(
    ("case", "unknown", "worst"),
    [
        (URP, "unknown f(a, b, c) by mlp(16, 16)", 0.02),
        (URP, "unknown f(a, b, c) >= 0 by mlp(16, 16)", 0.02),
        (URP, "unknown f(a, b, c) >= 0, decreasing in a, increasing in b, increasing in c by mlp(16, 16)", 0.02),
        (URP, "unknown f(a, b, c) >= 0, zero at a = 1 by mlp(16, 16)", 0.02),
        (HALDANE, "unknown f(a) by mlp(16, 16)", 0.01),
        (HALDANE, "unknown f(a) >= 0, zero at a = 0 by mlp(16, 16)", 0.01),
        (HALDANE, "unknown f(a in [0, 10]) >= 0, zero at a = 0 = a/(K + a)*nn by mlp(16, 16)", 0.01),
        (MONOD, "unknown f(a, b) by mlp(16, 16)", 0.02),
        (MONOD, "unknown f(a, b) >= 0, zero at a = 0, increasing in a, decreasing in b by mlp(16, 16)", 0.02),
        (
            MONOD,
            "unknown f(a in [0, 5], b) >= 0, increasing in a, decreasing in b = a/(0.3 + a)*nn by mlp(16, 16)",
            0.02,
        ),
    ],
)
def test_constrained_networks_fit(case: Any, unknown: str, worst: float) -> None:
    """URP's rate, Haldane's and an inhibited Monod law, to the error required of the plain network."""
    _, truth, ranges = case
    error = fitted(unknown, truth, ranges, 30)
    assert error < worst
