"""Right-hand sides as products of matrices equal the generated equations, and are taken where these are affine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import gbspec
from gbspec.backends.module import load_module
from gbspec.diagnostics import Findings
from gbspec.ir.affinity import is_affine
from gbspec.ir.model import Model
from gbspec.passes.contracts import with_contracts
from gbspec.training.engines import torch_arithmetic
from gbspec.training.engines.objective import objective
from gbspec.training.engines.torch.affine import Form, NotAffineError, affine
from gbspec.training.engines.torch.engine import TorchEngine
from tests.training.conftest import URP, model_of, problem_of, urp_data
from tests.training.reference import unroll

HEAD = """model tank
time t from 0
state a in [0, 2]
state b in [0, 2]
condition c in [0, 1]
condition e in [1, 2]
input F held
const k0 = 0.7
learn k1 = 0.5 in [0, 3]
learn k2 = 0.8 > 0 per trajectory
unknown p, q(a, b) by mlp(5, 4, activation=tanh)
unknown s(b) by mlp(4)
observe a
"""

CONTRACTS = {"n(a)": "unknown n(a) >= 0 by mlp(4)", "d(a)": "unknown d(a) increasing in a by mlp(4, 3)"}

AFFINE = {
    "two unknowns of one network": "a' = p\nb' = -2*q + p/k1",
    "inputs, conditions, constants of trajectories": "a' = F*k1 - k0*a + exp(c)*sqrt(e)\nb' = k2 - (a - b)/k1 + k2*e",
    "arguments that are sums": "a' = s(a - 3*b + k2*c + F) - a\nb' = s(2) - s(b) + 2*s(F/2)",
    "a direction": "a' = -d(a)\nb' = a",
    "nothing that moves": "a' = k2*c\nb' = 1",
}
OTHERS = {
    "a product of states": "a' = -a*b\nb' = a",
    "an input as a factor": "a' = -F*a\nb' = a",
    "an unknown as a factor": "a' = s(b)*a\nb' = a",
    "a function of a state": "a' = exp(-a)\nb' = a",
    "a power": "a' = a^2\nb' = 1/a",
    "a choice": "a' = if(a > 1, 0, a)\nb' = a",
    "the time": "a' = t\nb' = a",
    "the time as an argument": "a' = s(t)\nb' = a",
    "an unknown of an unknown": "a' = s(s(a))\nb' = a",
    "factors that differ between trajectories": "a' = -k2*a + k1*b\nb' = a",
    "a bound of an unknown": "a' = n(a)\nb' = a",
}


Points = tuple[Any, Any, dict[str, Tensor], tuple[Tensor, ...], list[Tensor]]


def model_of_balances(balances: str) -> Model:
    findings = Findings()
    model = with_contracts(model_of(text_of(balances)), findings)
    findings.raise_if_failed()
    return model


def points_of(model: Model) -> Points:
    """Module, arithmetic, weights; time, state, condition, inputs; constants; 7 points."""
    module, rng = load_module(model).random(3), np.random.default_rng(0)
    weights = {name: torch.from_numpy(np.array(value)) for name, value in module.weights.items()}
    for name, value in weights.items():
        if name.endswith(("_scale", "_center")):
            value += torch.from_numpy(rng.uniform(0.1, 0.5, value.shape))
        value.requires_grad_()
    widths = [(), (len(module.states),), (len(module.conditions),), (len(module.inputs),)]
    t, x, c, u = (torch.from_numpy(rng.uniform(0.5, 1.5, (7, *width))) for width in widths)
    own = {len(model.constants) + i for i, k in enumerate(model.learnables) if k.per_trajectory}
    values = rng.uniform(0.5, 1.5, (7, len(module.constants)))
    constants = [torch.tensor(v if i in own else v[0]).requires_grad_() for i, v in enumerate(values.T)]
    return module, torch_arithmetic(module), weights, (t, x.requires_grad_(), c, u), constants


def text_of(balances: str) -> str:
    used = [line for name, line in CONTRACTS.items() if name in balances]
    return "\n".join([HEAD, *used, balances, ""])


@pytest.mark.parametrize("name", AFFINE)
def test_the_matrices_give_what_the_equations_give(name: str) -> None:
    model = model_of_balances(AFFINE[name])
    assert is_affine(model)
    same(points_of(model))


@pytest.mark.parametrize("name", ["urp_bb", "bf_gb1", "alpha_pinene", "lotka_volterra", "one_compartment"])
def test_shipped_models_are_affine(name: str) -> None:
    model = gbspec.load(name).model
    assert is_affine(model)
    same(points_of(model))


def same(given: Points) -> None:
    module, ops, weights, (t, x, c, u), k = given
    networks = module.torch_networks(weights)
    expected = module.equations.rhs(ops, t, x, c, u, tuple(k), networks)
    shape = expected.shape
    found = affine(module, ops, c, k, networks).at(slice(7))(t, x, u)
    assert torch.allclose(found.expand(shape), expected, rtol=1e-13, atol=1e-13)
    weight = torch.linspace(0.5, 1.5, shape.numel(), dtype=torch.float64).reshape(shape)
    leaves = [*weights.values(), *k, x]
    for one, other in zip(gradients(expected * weight, leaves), gradients(found * weight, leaves), strict=True):
        assert torch.allclose(one, other, rtol=1e-12, atol=1e-12)
    part = slice(2, 5)
    some = affine(module, ops, c, k, networks).at(part)(t[part], x[part], u[part])
    assert torch.allclose(some.expand(3, shape[1]), expected[part], rtol=1e-13, atol=1e-13)


def gradients(out: Tensor, leaves: list[Tensor]) -> list[Tensor]:
    found = torch.autograd.grad(out.sum(), leaves, allow_unused=True, retain_graph=True)
    return [torch.zeros_like(leaf) if g is None else g for g, leaf in zip(found, leaves, strict=True)]


@pytest.mark.parametrize("name", OTHERS)
def test_other_equations_are_left_as_they_are(name: str) -> None:
    module, ops, weights, (_, _, c, _), k = points_of(model_of_balances(OTHERS[name]))
    with pytest.raises(NotAffineError):
        affine(module, ops, c, k, module.torch_networks(weights))
    assert not is_affine(model_of_balances(OTHERS[name]))


@pytest.mark.parametrize("value", [2.0, torch.tensor(2.0), torch.tensor([2.0, 2.0])])
def test_a_number_on_the_left_finds_the_form(value: Any) -> None:
    form = Form({("state", 0): 1.0}, 3.0)
    for found, slope, constant in ((value + form, 1.0, 5.0), (value - form, -1.0, -1.0), (value * form, 2.0, 6.0)):
        assert np.all(np.asarray(found.terms["state", 0]) == slope)
        assert np.all(np.asarray(found.constant) == constant)
    for refused in (lambda: value / form, lambda: value**form, lambda: value < form, lambda: value == form):
        with pytest.raises(NotAffineError):
            refused()


class Count(TorchDispatchMode):
    """How many operations torch does within."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_a_sub_step_takes_no_more_operations_than_by_hand() -> None:
    """Four times six (three products, two activations, the states' product), seven for the solver, one to force."""
    counts, depths = [], []
    for max_step in (0.1, 0.05):
        problem, parameters, theta = problem_of(model_of(URP), urp_data(4, 2.0, 6), max_step, blend=1.0)
        vector = torch.from_numpy(theta).requires_grad_()
        engine = TorchEngine(problem, parameters)
        path = engine.plan(theta)
        depths.append(engine.schedule(path).segments.depth)
        with Count() as counter:
            engine.unroll(vector, path)
        counts.append(counter.count)
    assert (counts[1] - counts[0]) / (depths[1] - depths[0]) < 4 * 6 + 7 + 1 + 0.5


@pytest.mark.parametrize("blend", [0.0, 1.0])
def test_single_precision_gives_the_gradient_of_double(blend: float) -> None:
    problem, parameters, theta = problem_of(model_of(URP), urp_data(4, 2.0, 6), 0.1, blend=blend)
    found = []
    for dtype in (torch.float64, torch.float32):
        vector = torch.from_numpy(theta).to(dtype).requires_grad_()
        residuals = unroll(problem, parameters, vector).residuals
        assert residuals.dtype == dtype
        found.append(torch.autograd.grad((residuals**2).sum(), vector)[0].double())
    assert torch.linalg.norm(found[1] - found[0]) < 1e-5 * torch.linalg.norm(found[0])
    loss, gradient = objective(problem, parameters, "torch", "float32")(theta)
    assert gradient.dtype == np.float64
    expected = 0.5 * found[1].numpy() / (problem.packed.weights > 0).sum()
    assert np.allclose(gradient, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert loss == pytest.approx(objective(problem, parameters, "torch")(theta)[0], rel=1e-5)


def test_all_trajectories_are_the_problem_itself() -> None:
    problem, *_ = problem_of(model_of(URP), urp_data(4, 2.0, 6), 0.1)
    assert problem.take(range(4)) is problem, "what was prepared for it is kept"
    assert problem.take([1, 0, 2, 3]) is not problem
