"""The generated module as other programs use it: types, names of components, tensors as constants, pickling."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from mypy import api as mypy

import gbspec
from gbspec.backends.module import generate, load_module
from gbspec.ir.model import Model
from tests.backends.examples import clinic, reactor
from tests.training.conftest import model_of


def test_modules_pass_mypy_strict(tmp_path: Path) -> None:
    models = [reactor(), clinic(), *(gbspec.load(name).model for name in ("spreading_population", "fed_batch"))]
    for model in models:
        (tmp_path / f"{model.name}.py").write_text(generate(model), encoding="utf-8")
    files = [str(tmp_path / f"{model.name}.py") for model in models]
    here = Path(__file__).parents[2]  # whose cache `make lint` has filled, with torch and numpy
    flags = ("--strict", f"--config-file={here / 'pyproject.toml'}", f"--cache-dir={here / '.mypy_cache'}")
    found, errors, status = mypy.run([*flags, *files])
    assert status == 0, found + errors


# ---------------------------------------------------------------------- names
def test_states_and_conditions_are_given_by_name() -> None:
    model = load_module(reactor()).random(0)
    assert model.state(x2=1.2, x1=0.3).tolist() == [0.3, 1.2]
    assert model.state({"x1": 0.3}, x2=[1.0, 2.0]).tolist() == [[0.3, 1.0], [0.3, 2.0]]
    assert model.condition(Da=0.3).tolist() == [0.3]
    assert model.input().shape == (0,)
    wanted = model.rhs(0.0, [0.3, 1.2], [0.3])
    assert torch.equal(model.rhs(0.0, {"x1": 0.3, "x2": 1.2}, {"Da": 0.3}), wanted)
    assert torch.equal(model.rhs(0.0, model.state(x1=0.3, x2=1.2), model.condition(Da=0.3)), wanted)


def test_a_component_may_have_any_name() -> None:
    model = load_module(model_of("model m\nstate values\nstate cls\nvalues' = -cls\ncls' = values\nobserve values\n"))
    assert model.state(values=0.3, cls=1.2).tolist() == [0.3, 1.2]


def test_an_input_that_is_left_out_has_its_default() -> None:
    model = load_module(clinic()).random(0)
    assert model.input().tolist() == [0.5]
    table = {"u": [1.0, 2.0]}
    by_name = model.simulate([1.0, 2.0, 3.0], [0.0, 1.0], inputs=table)
    assert torch.equal(by_name, model.simulate([1.0, 2.0, 3.0], [0.0, 1.0], inputs=[[1.0], [2.0]]))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"x1": 1.0}, "the states are x1, x2: x2 is missing"),
        ({"x1": 1.0, "x2": 2.0, "x3": 3.0}, "x3 is not among them"),
    ],
)
def test_wrong_names_are_told(names: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_module(reactor()).state(**names)


def test_a_tensor_keeps_its_gradient_when_it_is_given_by_name() -> None:
    model = load_module(reactor()).random(0)
    x1 = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(model.rhs(0.0, model.state(x1=x1, x2=1.2), {"Da": 0.3})[1], x1)
    assert float(gradient) == pytest.approx(model.casadi_jacobian()(0.0, [0.3, 1.2], [0.3], [])[1, 0])


# ---------------------------------------------------------------------- tensors as constants and weights
def test_gradients_reach_constants_through_a_simulation() -> None:
    model = load_module(reactor()).random(1)

    def end(value: torch.Tensor | float) -> torch.Tensor:
        found: torch.Tensor = model.simulate([0.3, 1.2], [0.0, 0.5], [0.3], constants={"B": value}, max_step=0.1)
        return found[-1, 1]

    B = torch.tensor(7.0, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(end(B), B)
    assert float(gradient) == pytest.approx(float(end(7.0 + 1e-5) - end(7.0 - 1e-5)) / 2e-5, rel=1e-6)


def test_a_batch_of_constants_makes_a_batch_of_solutions() -> None:
    model = load_module(reactor()).random(1)
    values = torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64)
    together = model.simulate([0.3, 1.2], [0.0, 0.5, 1.0], [0.3], constants={"B": values})
    assert together.shape == (3, 3, 2)
    for row, value in zip(together, values, strict=True):
        alone = model.simulate([0.3, 1.2], [0.0, 0.5, 1.0], [0.3], constants={"B": float(value)})
        assert torch.allclose(row, alone, rtol=1e-14)


def test_gradients_reach_weights_in_every_backward_pass() -> None:
    plain = load_module(reactor()).random(2)
    weights = {name: torch.tensor(value, requires_grad=True) for name, value in plain.weights.items()}
    model = plain.with_weights(weights)
    assert torch.equal(model.rhs(0.0, [0.3, 1.2], [0.3]), plain.rhs(0.0, [0.3, 1.2], [0.3]))
    for _ in range(2):
        model.simulate([0.3, 1.2], [0.0, 0.5], [0.3]).sum().backward()
    name, h = "network.phi.1.weight", 1e-6
    shift = np.zeros_like(plain.weights[name])
    shift[2, 3] = h
    ahead, behind = (
        plain.with_weights({name: plain.weights[name] + s}).simulate([0.3, 1.2], [0.0, 0.5], [0.3]).sum()
        for s in (shift, -shift)
    )
    found = weights[name].grad
    assert found is not None
    assert float(found[2, 3]) == pytest.approx(2 * float(ahead - behind) / (2 * h), rel=1e-6)
    assert weights["constants"].grad is not None
    with pytest.raises(ValueError, match=r"network\.phi\.9"):
        plain.with_weights({"network.phi.9.weight": torch.zeros(1)})


# ---------------------------------------------------------------------- pickling, copies, texts
@pytest.mark.parametrize("make", [reactor, clinic])
def test_an_instance_that_was_used_can_be_pickled_and_copied(make: Callable[[], Model]) -> None:
    model = load_module(make()).random(3)
    model.info["max_step"] = 0.25
    x, condition = [0.3] * len(model.states), [0.3] * len(model.conditions)
    wanted = model.rhs(0.0, x, condition)
    assert model.functions
    for again in (pickle.loads(pickle.dumps(model)), copy.deepcopy(model), copy.copy(model)):
        assert type(again) is type(model)
        assert again.info == {"max_step": 0.25}
        assert torch.equal(again.rhs(0.0, x, condition), wanted)


def test_a_pickled_instance_is_loaded_by_another_process(tmp_path: Path) -> None:
    model = load_module(reactor()).random(3)
    (tmp_path / "model.pickle").write_bytes(pickle.dumps(model))
    program = "import pickle; print(pickle.load(open('model.pickle', 'rb')).numpy_networks()[0](0.1, 0.2, 0.3)[0])"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == float(model.numpy_networks()[0](0.1, 0.2, 0.3)[0])


def test_the_compiled_module_s_instances_can_be_pickled(tmp_path: Path) -> None:
    (tmp_path / "urp_gb2.py").write_text(generate(reactor()), encoding="utf-8")
    program = "import pickle; from urp_gb2 import UrpGb2; m = UrpGb2.random(1); print(pickle.loads(pickle.dumps(m)))"
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "UrpGb2(B=5, beta=1, phi: 3-8-8-1)"


def test_help_names_components_units_and_shapes() -> None:
    text = load_module(clinic()).__doc__ or ""
    for line in (
        "t [...]: time (h)",
        "x, the state [..., 3]: x (mg), state, g",
        "inputs [..., 1]: u (mg/h)",
        "functions [..., arguments] -> [...]: q(S), h(x, g), r(x, g)",
    ):
        assert line in text
    many = load_module(gbspec.load("spreading_population").model).__doc__ or ""
    assert len(many) < 2000


def test_labels_of_groups_are_no_conditions_of_a_simulation() -> None:
    """No equation has them; whoever gives one gets the same."""
    text = """model grouped
condition dose in [50, 200]
state A
learn k = 0.3 in [0.1, 5] per trajectory ~ lognormal(0.2) per person ~ lognormal(0.3)
A' = -k*A
initial A = dose
observe A noise normal(0.1)
"""
    module = load_module(model_of(text))()
    found = [module.simulate([100.0], [0.0, 2.0], given) for given in ({"dose": 100.0}, {"dose": 100.0, "person": 7.0})]
    assert module.conditions == ("dose", "person")
    assert float(found[0][-1, 0]) == pytest.approx(100 * math.exp(-0.6), rel=2e-3)
    assert bool((found[0] == found[1]).all())
    with pytest.raises(ValueError, match="dose is missing"):
        module.simulate([100.0], [0.0, 2.0], {"person": 7.0})
