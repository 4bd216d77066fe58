"""ONNX graphs against the generated module, by onnxruntime."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from gbspec.backends import load_module
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import ComputationError, Findings, UserError
from gbspec.exports import ExportOptions, Precision
from gbspec.frontend import load_model
from gbspec.operations import exporting, models
from tests.backends.examples import clinic, reactor
from tests.exports.texts import BUNDLED, CHOICES, DOSED, exported, model_of

onnx = pytest.importorskip("onnx", reason="the package onnx is not installed")
pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed")

from gbspec.exports.onnx import make  # noqa: E402 - it imports onnx
from gbspec.exports.onnx.graph import Graph  # noqa: E402
from gbspec.exports.onnx.operators import Operators  # noqa: E402
from gbspec.exports.onnx.verifying import run  # noqa: E402

TOLERANCE: dict[Precision, float] = {"float64": 1e-12, "float32": 1e-5}
PRECISIONS = pytest.mark.parametrize("precision", list(TOLERANCE))


@PRECISIONS
@pytest.mark.parametrize("name", BUNDLED)
def test_every_bundled_model(name: str, precision: Precision) -> None:
    made = make(exported(load_model(shipped_models()[name], Findings())), ExportOptions(precision=precision))
    assert len(made.checked) >= 3
    assert max(one.error for one in made.checked) < TOLERANCE[precision]


@PRECISIONS
@pytest.mark.parametrize("activation", ["silu", "tanh", "softplus", "relu", "gelu", "sigmoid", "elu", "sin"])
def test_choices_and_activations(activation: str, precision: Precision) -> None:
    made = make(exported(model_of(CHOICES.replace("silu", activation))), ExportOptions(precision=precision))
    assert max(one.error for one in made.checked) < TOLERANCE[precision]


@PRECISIONS
def test_contracts_and_odd_names(precision: Precision) -> None:
    for model in (model_of(DOSED), reactor(), clinic()):
        made = make(exported(model), ExportOptions(precision=precision))
        assert max(one.error for one in made.checked) < TOLERANCE[precision]


FUNCTIONS = {
    "exp": (np.exp, -700, 700), "log": (np.log, 1e-300, 1e3), "sqrt": (np.sqrt, 0, 1e6), "sin": (np.sin, -9, 9),
    "cos": (np.cos, -9, 9), "tan": (np.tan, -1.5, 1.5), "tanh": (np.tanh, -30, 30), "sinh": (np.sinh, -20, 20),
    "cosh": (np.cosh, -20, 20), "asin": (np.arcsin, -1, 1), "acos": (np.arccos, -1, 1), "atan": (np.arctan, -90, 90),
    "asinh": (np.arcsinh, -1e6, 1e6), "acosh": (np.arccosh, 1, 1e6), "atanh": (np.arctanh, -0.999, 0.999),
    "softplus": (lambda x: np.logaddexp(x, 0.0), -60, 60), "logistic": (lambda x: 1 / (1 + np.exp(-x)), -600, 600),
    "erf": (np.vectorize(math.erf), -9, 9), "abs": (np.abs, -3, 3), "sign": (np.sign, -3, 3),
    "floor": (np.floor, -3, 3),
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_functions_keep_all_digits_in_double_precision(name: str) -> None:
    """Also for small arguments, where differences lose digits."""
    function, low, high = FUNCTIONS[name]
    graph = Graph(name, "float64")
    x = graph.input("x", 1)
    graph.output("y", [Operators(graph).apply(name, x)])
    span = np.linspace(low, high, 801)
    small = np.geomspace(1e-12, 1, 200)
    points = np.concatenate([span, *(s * small for s in (1, -1) if low <= -1 or s > 0)])
    points = points[(points >= low) & (points <= high)][:, None]
    found, known = run(graph.bytes({"gbspec": "0"}, name), {"x": points}), function(points)
    # where the logarithm has its zero, its argument decides
    scale = np.maximum(np.abs(known), 1.0 if name in ("sin", "cos") else np.finfo(float).tiny)
    assert np.max(np.abs(found - known) / scale) < 4e-15


def test_both_sides_of_the_cut_of_atan2() -> None:
    graph = Graph("atan2", "float64")
    y, x = graph.columns(graph.input("z", 2), 2)
    graph.output("angle", [Operators(graph).apply("atan2", y, x)])
    points = np.array([[a, b] for a in (-2.0, -0.5, 0.0, 0.5, 2.0) for b in (-3.0, -0.5, 0.0, 0.5, 3.0)])
    found = run(graph.bytes({"gbspec": "0"}, "atan2"), {"z": points})[:, 0]
    assert found == pytest.approx(np.arctan2(points[:, 0], points[:, 1]), abs=1e-15)


def test_constants_have_defaults_and_may_be_given(tmp_path: Path) -> None:
    import onnxruntime

    findings = Findings()
    subject = models.subject("urp_gb2", {}, findings)
    made = exporting.export(subject, tmp_path / "graphs", "onnx", ExportOptions(), findings, "urp_gb2")
    assert set(made.files) == {"rhs.onnx", "observe.onnx", "step.onnx", "model.gb", "export.json"}
    assert json.loads((tmp_path / "graphs" / "export.json").read_text())["fingerprint"] == made.fingerprint
    session = onnxruntime.InferenceSession(tmp_path / "graphs" / "rhs.onnx", providers=["CPUExecutionProvider"])
    assert "model urp_gb2" in session.get_modelmeta().custom_metadata_map["text"]
    given = {"t": np.zeros(3), "x": np.full((3, 2), 0.4), "condition": np.full((3, 1), 0.3)}
    (default,) = session.run(None, given)
    constants = subject.evaluator.constants[None, :] * 1.1
    (other,) = session.run(None, {**given, "constants": constants})
    assert default == pytest.approx(subject.evaluator.rhs_many(np.zeros(3), given["x"], given["condition"]))
    known = subject.evaluator.rhs_many(np.zeros(3), given["x"], given["condition"], constants=constants[0])
    assert other == pytest.approx(known)


def test_one_graph_alone(tmp_path: Path) -> None:
    findings = Findings()
    subject = models.subject("lotka_volterra", {}, findings)
    made = exporting.export(subject, tmp_path / "a.onnx", "onnx", ExportOptions(part="step"), findings)
    assert made.files == ("step.onnx",) and onnx.load(tmp_path / "a.onnx").graph.name == "step"
    exporting.export(subject, tmp_path / "b.onnx", "onnx", ExportOptions(), findings)
    assert onnx.load(tmp_path / "b.onnx").graph.name == "rhs"
    for options, form, code in (
        (ExportOptions(part="psi"), "onnx", "GB884"),
        (ExportOptions(part="rhs"), "c", "GB881"),
    ):
        with pytest.raises(UserError, match=code):
            exporting.export(subject, tmp_path / "c", form, options, findings)
    with pytest.raises(UserError, match=r"GB881.*`precision`"):
        exporting.export(subject, tmp_path / "c", "c", ExportOptions(precision="float32"), findings)


def test_without_onnxruntime_the_evaluator_of_onnx_compares(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    made = make(exported(model_of(CHOICES)), ExportOptions())
    assert max(one.error for one in made.checked) < 1e-12


def test_without_onnx_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'onnx'", name="onnx")

    monkeypatch.setattr("gbspec.exports.onnx.make", missing)
    findings = Findings()
    subject = models.subject("methanol", {}, findings)
    with pytest.raises(UserError, match="GB866") as raised:
        exporting.export(subject, tmp_path / "x", "onnx", ExportOptions(), findings)
    assert "gbspec[onnx]" in raised.value.diagnostics[0].help


def test_a_difference_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Operators, "activation", lambda self, kind, z: z)
    with pytest.raises(ComputationError, match=r"`onnx` differs .* the right-hand side by"):
        make(exported(reactor()), ExportOptions())


def test_a_function_may_be_called_like_a_graph() -> None:
    model = model_of("model m\nstate x in [0, 1]\nunknown step(x) by mlp(3)\nx' = -step(x)\nobserve x\n")
    made = make(exported(model), ExportOptions())
    assert "function_step.onnx" in made.files and "step.onnx" in made.files
    assert load_module(model).unknowns == ("step",)
