"""The generated module as its user sees it: standalone, checked weights, torch and casadi, batches, gradients."""

from __future__ import annotations

import dataclasses
import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import sympy
import torch

from gbspec.backends.module import generate, load_module
from gbspec.backends.module.filling import fill, template
from gbspec.diagnostics import Defect
from gbspec.ir.model import Channel, Constant, Input, Model, State, symbol
from tests.backends.examples import clinic, reactor

STANDALONE = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("gbspec", "sympy"):
            raise ImportError(f"{name} is not to be imported")

sys.meta_path.insert(0, Refuse())
from urp_gb2 import UrpGb2

assert not {"torch", "casadi", "scipy", "safetensors"} & set(sys.modules), "loaded at import"
model = UrpGb2.load("weights.safetensors")
assert "torch" not in sys.modules
dx = model.rhs(0.0, [0.3, 1.2], [0.3])
assert "casadi" not in sys.modules
same = model.casadi_rhs()(0.0, [0.3, 1.2], [0.3], [])
print(repr([float(v) for v in dx]), repr([float(v) for v in same.full().ravel()]))
"""


def test_standalone(tmp_path: Path) -> None:
    (tmp_path / "urp_gb2.py").write_text(generate(reactor()), encoding="utf-8")
    instance = load_module(reactor()).random(4)
    instance.save(tmp_path / "weights.safetensors")
    done = subprocess.run([sys.executable, "-c", STANDALONE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    here = [float(v) for v in instance.rhs(0.0, [0.3, 1.2], [0.3])]
    there, casadi = (json.loads(part + "]") for part in done.stdout.strip().split("]")[:2])
    assert there == here
    assert casadi == pytest.approx(here, rel=1e-12)


def test_one_class_a_text() -> None:
    assert load_module(reactor()) is load_module(reactor())
    assert load_module(reactor()) is not load_module(clinic())


# ---------------------------------------------------------------------- weights
def test_weights_round_trip_and_are_safetensors(tmp_path: Path) -> None:
    cls = load_module(reactor())
    instance = cls.random(1)
    instance.info["max_step"] = 0.1
    instance.save(tmp_path / "w.safetensors")
    again = cls.load(tmp_path / "w.safetensors")
    assert again.info == {"max_step": 0.1}
    assert {name: value.tolist() for name, value in again.weights.items()} == {
        name: value.tolist() for name, value in instance.weights.items()
    }
    official = safetensors.numpy.load_file(tmp_path / "w.safetensors")
    assert all(np.array_equal(official[name], value) for name, value in instance.weights.items())
    safetensors.numpy.save_file(official, tmp_path / "official.safetensors")
    assert cls.load(tmp_path / "official.safetensors").weights.keys() == instance.weights.keys()


def test_a_run_directory_is_read_by_member(tmp_path: Path) -> None:
    cls = load_module(reactor())
    for member in range(2):
        (tmp_path / "members" / str(member)).mkdir(parents=True)
        cls.random(member).save(tmp_path / "members" / str(member) / "weights.safetensors")
    name = "network.phi.0.weight"
    assert np.array_equal(cls.load(tmp_path, 1).weights[name], cls.random(1).weights[name])
    assert np.array_equal(cls.load(tmp_path).weights[name], cls.random(0).weights[name])
    with pytest.raises(FileNotFoundError):
        cls.load(tmp_path, 2)


def test_weights_that_do_not_fit_are_refused_with_all_reasons() -> None:
    weights = load_module(reactor()).random(0).weights
    weights["network.phi.0.weight"] = np.zeros((8, 2))
    weights["network.phi.1.bias"] = np.full(8, np.nan)
    weights["extra"] = np.zeros(1)
    del weights["constants"]
    with pytest.raises(ValueError, match="do not fit") as caught:
        load_module(reactor())(weights)
    text = str(caught.value)
    assert "`network.phi.0.weight` has the shape [8, 2] instead of [8, 3]" in text
    assert "`network.phi.1.bias` has entries that are not finite" in text
    assert "`extra` belongs to no part" in text
    assert "`constants` is missing" in text


def test_what_training_keeps_beside_the_weights_is_accepted() -> None:
    cls = load_module(clinic())
    weights = cls.random(0).weights
    weights |= {"initial": np.zeros((4, 3)), "per_trajectory.lambda": np.ones(4), "network.q.input_low": np.zeros(1)}
    assert cls(weights).weights["initial"].shape == (4, 3)
    with pytest.raises(ValueError, match=r"per_trajectory\.g0"):
        cls({**weights, "per_trajectory.g0": np.ones(4)})


def test_unknown_functions_need_weights() -> None:
    with pytest.raises(ValueError, match="random"):
        load_module(reactor())()


def header(table: Any, body: bytes = b"", length: int | None = None) -> bytes:
    text = table if isinstance(table, bytes) else json.dumps(table).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + body


ENTRY = {"dtype": "F64", "shape": [1], "data_offsets": [0, 8]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "shorter"),
        (b"\x00" * 7, "shorter"),
        (header({}, length=2**60), "claims"),
        (header(b"{nonsense"), "cannot be read"),
        (header(b"\xff\xfe"), "cannot be read"),
        (header(b"[]"), "no table"),
        (header(b'{"a": {}, "a": {}}'), "twice"),
        (header({"__metadata__": {"info": 3}}), "no strings"),
        (header({"a": {**ENTRY, "dtype": "F99"}}, bytes(8)), "unknown type"),
        (header({"a": {"dtype": "F64"}}, bytes(8)), "incomplete"),
        (header({"a": 3}, bytes(8)), "incomplete"),
        (header({"a": {**ENTRY, "shape": 1}}, bytes(8)), "incomplete"),
        (header({"a": {**ENTRY, "shape": [-1]}}, bytes(8)), "no whole numbers"),
        (header({"a": {**ENTRY, "shape": [True]}}, bytes(8)), "no whole numbers"),
        (header({"a": {**ENTRY, "shape": [2]}}, bytes(8)), "should have 16 bytes"),
        (header({"a": {**ENTRY, "data_offsets": [8, 16]}}, bytes(8)), "should have 8 bytes"),
        (header({"a": ENTRY, "b": ENTRY}, bytes(8)), "overlap"),
        (header({"a": ENTRY}, bytes(9)), "gaps"),
        (header({"__metadata__": {"info": "[1]"}, "constants": ENTRY}, bytes(8)), "safetensors"),
    ],
)
def test_malformed_weights_files_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        load_module(reactor()).load(path)


# ---------------------------------------------------------------------- torch
def test_arguments_may_be_numbers_lists_arrays_and_tensors() -> None:
    instance = load_module(reactor()).random(0)
    wanted = instance.rhs(0.0, torch.tensor([0.3, 1.2], dtype=torch.float64), torch.tensor([0.3], dtype=torch.float64))
    for x, condition in (([0.3, 1.2], [0.3]), (np.array([0.3, 1.2]), 0.3), ((0.3, 1.2), (0.3,))):
        assert torch.equal(instance.rhs(0, x, condition), wanted)
    assert wanted.dtype == torch.float64
    assert instance.rhs(0.0, torch.tensor([0.3, 1.2]), 0.3).dtype == torch.float32


def test_wrong_shapes_are_named() -> None:
    instance = load_module(reactor()).random(0)
    with pytest.raises(ValueError, match="the state must have 2 numbers"):
        instance.rhs(0.0, [1.0, 2.0, 3.0], [0.3])
    with pytest.raises(ValueError, match="Da has no default"):
        instance.rhs(0.0, [1.0, 2.0])
    with pytest.raises(ValueError, match="no constant is called gamma"):
        instance.rhs(0.0, [1.0, 2.0], [0.3], constants={"gamma": 1.0})
    with pytest.raises(ValueError, match="phi takes 3 arguments"):
        instance.functions["phi"](1.0, 2.0)


def test_functions_of_tensors_and_of_separate_arguments() -> None:
    instance = load_module(clinic()).random(2)
    arguments = torch.rand(5, 2, dtype=torch.float64)
    h = instance.functions["h"]
    assert h(arguments).shape == (5,)
    assert torch.equal(h(arguments[:, 0], arguments[:, 1]), h(arguments))
    s = torch.rand(5, 1, dtype=torch.float64)
    assert torch.equal(instance.functions["q"](s), instance.functions["q"](s[:, 0]))
    assert float(instance.functions["q"](0.0)) == 0.0
    casadi = instance.casadi_function("q", symbolic_constants=True)
    doubled = float(instance.functions["q"](0.7, constants={"lambda": 3.0}))
    assert float(casadi(0.7, [0.1, 3.0])) == pytest.approx(doubled, rel=1e-13)


def test_simulate_converges_to_the_solution_with_linear_and_held_inputs() -> None:
    x, u, a = symbol("x"), symbol("u"), symbol("a")
    for kind in ("linear", "held"):
        model = Model(
            name="filter",
            states=(State("x"),),
            inputs=(Input("u", interpolation=kind),),  # type: ignore[arg-type]
            constants=(Constant("a", value=2.0),),
            balances=(-a * x + u,),
            channels=(Channel("x", value=x, state=0),),
        )
        instance = load_module(model)()
        times, values = np.array([0.0, 0.4, 1.0]), np.array([[1.0], [2.0], [0.0]])
        found = instance.simulate([[3.0], [0.0]], times, inputs=values, max_step=0.01)
        assert found.shape == (2, 3, 1)
        for start, row in zip((3.0, 0.0), found, strict=True):
            exact = [start]
            for i in range(2):
                h, u0 = times[i + 1] - times[i], values[i, 0]
                slope = (values[i + 1, 0] - u0) / h if kind == "linear" else 0.0
                particular = lambda t, u0=u0, s=slope: u0 / 2 + s * (t / 2 - 0.25)  # noqa: E731
                exact.append((exact[-1] - particular(0.0)) * np.exp(-2 * h) + particular(h))
            assert row[:, 0].tolist() == pytest.approx(exact, abs=1e-8)
        by_function = instance.simulate([3.0], [0.0, 0.4], inputs=lambda t: [1.0], max_step=0.01)
        if kind == "held":
            assert torch.allclose(by_function, found[0, :2], atol=1e-14)
        with pytest.raises(ValueError, match="a row for each time"):
            instance.simulate([3.0], times, inputs=[[1.0]])
        with pytest.raises(ValueError, match="increase"):
            instance.simulate([3.0], [0.0, 0.0], inputs=[[1.0], [1.0]])


def test_simulate_is_differentiable_and_uses_the_training_step_by_default() -> None:
    instance = load_module(reactor()).random(3)
    x0 = torch.tensor([0.3, 1.2], dtype=torch.float64, requires_grad=True)
    instance.info["max_step"] = 0.1
    end = instance.simulate(x0, [0.0, 1.0], [0.3])[-1]
    assert torch.equal(end, instance.simulate(x0, [0.0, 1.0], [0.3], max_step=0.1)[-1])
    assert not torch.equal(end, instance.simulate(x0, [0.0, 1.0], [0.3], max_step=1.0)[-1])
    (gradient,) = torch.autograd.grad(end[0], x0)
    h = 1e-6
    for i in range(2):
        shift = torch.eye(2, dtype=torch.float64)[i] * h
        ahead, behind = (instance.simulate(x0 + s, [0.0, 1.0], [0.3])[-1, 0] for s in (shift, -shift))
        assert float(gradient[i]) == pytest.approx((ahead - behind).item() / (2 * h), rel=1e-6)


def test_per_trajectory_constants_broadcast() -> None:
    instance = load_module(clinic()).random(5)
    x = torch.rand(4, 3, dtype=torch.float64)
    rates = torch.tensor([0.5, 1.0, 2.0, 4.0], dtype=torch.float64)
    together = instance.rhs(0.2, x, constants={"lambda": rates})
    single = [instance.rhs(0.2, x[i], constants={"lambda": float(rates[i])}) for i in range(4)]
    assert torch.allclose(together, torch.stack(single), rtol=1e-14, atol=0.0)


def test_the_tape_gives_the_gradient_of_every_weight() -> None:
    instance = load_module(reactor()).random(6)
    cls = type(instance)
    x = torch.rand(7, 2, dtype=torch.float64)
    condition = torch.full((7, 1), 0.3, dtype=torch.float64)
    weights = {name: torch.tensor(value, requires_grad=True) for name, value in instance.weights.items()}
    tape: list[tuple[int, int, torch.Tensor, torch.Tensor]] = []
    networks = instance.torch_networks(weights, tape)
    constants = tuple(weights["constants"].unbind())
    result = cls.equations.rhs(
        cls.arithmetic("torch"), torch.tensor(0.0), x, condition, None, constants, networks
    ).sum()
    assert [(network, layer) for network, layer, _, _ in tape] == [(0, 0), (0, 1), (0, 2)]
    cotangents = torch.autograd.grad(result, [z for *_, z in tape], retain_graph=True)
    for (_, layer, a, _), cotangent in zip(tape, cotangents, strict=True):
        whole = torch.autograd.grad(result, weights[f"network.phi.{layer}.weight"], retain_graph=True)[0]
        bias = torch.autograd.grad(result, weights[f"network.phi.{layer}.bias"], retain_graph=True)[0]
        assert torch.allclose(cotangent.T @ a, whole, rtol=1e-12)
        assert torch.allclose(cotangent.sum(0), bias, rtol=1e-12)
    assert torch.allclose(instance.rhs(0.0, x, condition).sum(), result, rtol=1e-12)


@pytest.mark.parametrize(
    ("expression", "at", "derivative"),
    [
        (lambda x: sympy.Piecewise((sympy.sqrt(x), x > 0), (0, True)), 0.0, 0.0),
        (lambda x: sympy.Piecewise((sympy.log(x), x > 1), (x, True)), 0.0, 1.0),
        (
            lambda x: sympy.Piecewise((1 / (1 + sympy.exp(-x)), x > 0), (sympy.exp(x) / (1 + sympy.exp(x)), True)),
            -1e3,
            0.0,
        ),
        (lambda x: sympy.Piecewise((1 / x, x > 0), (2 * x, x < -1), (x**2, True)), 0.0, 0.0),
        (
            lambda x: (
                3 * sympy.Piecewise((x, x < 1), (sympy.Piecewise((sympy.log(x - 2), x > 2), (5 * x, True)), True))
            ),
            2.0,
            15.0,
        ),
    ],
)
def test_gradients_ignore_the_branch_that_is_not_taken(expression: Any, at: float, derivative: float) -> None:
    x = symbol("x")
    model = Model(name="choice", states=(State("x"),), balances=(expression(x),), channels=(Channel("x", value=x),))
    instance = load_module(model)()
    value = torch.tensor([at], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(instance.rhs(0.0, value).sum(), value)
    assert gradient.tolist() == [derivative]
    assert float(instance.casadi_jacobian()(0.0, at, [], [])) == derivative


# ---------------------------------------------------------------------- text
def test_floats_round_trip() -> None:
    values = [0.1, 1 / 3, 1e-300, 1.7976931348623157e308, 5e-324, 2.0**53 + 2, 123456789.123456789]
    model = Model(
        name="floats",
        states=tuple(State(f"x{i}") for i in range(len(values))),
        constants=tuple(Constant(f"k{i}", value=value) for i, value in enumerate(values)),
        balances=tuple(sympy.Float(value, 17) * symbol(f"x{i}") for i, value in enumerate(values)),
        channels=(Channel("x0", value=symbol("x0")),),
    )
    instance = load_module(model)()
    assert instance.weights["constants"].tolist() == values
    assert instance.rhs(0.0, np.ones(len(values))).tolist() == values


@pytest.mark.parametrize(
    "name", ["path", "none", "any", "true", "mapping", "simple_namespace", "INTERFACE", "template"]
)
def test_class_names_that_the_module_needs(name: str) -> None:
    instance = load_module(dataclasses.replace(reactor(), name=name)).random(0)
    assert instance.rhs(0.0, [0.3, 1.2], [0.3]).shape == (2,)


def test_texts_of_a_model_are_only_text() -> None:
    hostile = 'a """ \\ # {{class}}\nimport os; {x} "'
    model = dataclasses.replace(
        reactor(), title=hostile, states=(State("x1", description=hostile), State("x2", unit='m"', description="'"))
    )
    cls = load_module(model)
    assert cls.title == hostile
    assert cls.descriptions["x1"] == hostile
    assert cls.units["x2"] == 'm"'


def test_every_place_of_the_template_is_filled() -> None:
    with pytest.raises(Defect, match="places"):
        fill(template(), {"docstring": "", "class": ""})
    with pytest.raises(Defect, match="places"):
        fill("a = 1  # {{one}}\nb = 2  # {{one}}\n", {"one": "a = 3"})
    assert fill("def f():\n    a = 1  # {{one}}\n", {"one": "b = 2\nc = 3"}) == "def f():\n    b = 2\n    c = 3\n"
