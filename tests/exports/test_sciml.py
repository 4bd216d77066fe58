"""export --as petab of models with networks: PEtab-SciML files, imported again with the same likelihood."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.backends import Evaluator, load_module
from gbspec.diagnostics import Findings, UserError
from gbspec.exports import ExportOptions
from gbspec.operations import exporting, models, tables
from gbspec.operations.importing import import_file
from gbspec.training import Given, evaluate

pytest.importorskip("libsbml", reason="SBML needs the extra `sbml`")
yaml = pytest.importorskip("yaml", reason="PEtab needs the extra `sbml`")
h5py = pytest.importorskip("h5py", reason="PEtab-SciML needs the extra `sbml`")

MODEL = """model m
state x = 0.5
state y = 1
learn k = 0.7 in [0, 2]
unknown f(x, y) = k*nn/(1 + x^2) by mlp(3, 2, activation=tanh)
unknown g(y) by mlp(2, activation=silu)
x' = f(x, y) - x
y' = -y*g(y)
initial x = 0.5
initial y = 1
observe x noise normal(0.1)
observe y noise normal(0.2)
"""
TABLE = "t,x,y\n0.5,0.4,0.9\n1,0.3,1.1\n2,0.2,0.7\n"


def exported(folder: Path, text: str) -> tuple[float, dict[str, float], Path]:
    """The negative log likelihood and its gradient with random weights, and the problem."""
    (folder / "m.gb").write_text(text)
    (folder / "d.csv").write_text(TABLE)
    model = gbspec.load(folder / "m.gb").model
    data = tables.read_data(str(folder / "d.csv"), model, Findings())
    instance = load_module(model).random(1)
    options = ExportOptions(verify=False, data=data)
    exporting.export(models.Subject(model, Evaluator(instance)), folder / "out", "petab", options, Findings())
    constants = np.array([[k.start for k in model.learnables]])
    before = evaluate(model, data, Given(constants, np.array([[0.5, 1.0]]), instance.weights, {}))
    return before.nllh, dict(before.gradient), folder / "out" / "problem.yaml"


def test_a_round_trip_has_the_same_likelihood(tmp_path: Path) -> None:
    nllh, gradient, problem = exported(tmp_path, MODEL)
    document = yaml.safe_load(problem.read_text())
    networks = document["extensions"]["sciml"]["neural_networks"]
    assert len(networks) == 2
    first = yaml.safe_load((problem.parent / networks["f_network"]["location"]).read_text())
    assert [one["args"]["out_features"] for one in first["layers"]] == [3, 2, 1]
    with h5py.File(problem.parent / "weights.hdf5") as file:
        assert file["parameters/f_network/layer2/weight"].shape == (2, 3)
    found = import_file(problem, tmp_path / "again")
    assert "learn f_network_layer2_weight_1_2" in Path(found.model).read_text()
    assert found.data is not None
    after = gbspec.evaluate(found.model, found.data)
    assert after.nllh == pytest.approx(nllh, rel=1e-8)
    assert after.gradient["k"] == pytest.approx(gradient["k"], rel=1e-5)


def test_a_network_that_is_applied_twice_is_in_formulas(tmp_path: Path) -> None:
    text = MODEL.replace("x' = f(x, y) - x", "x' = f(x, y) - f(y, x)").replace("y' = -y*g(y)", "y' = -y")
    nllh, _, problem = exported(tmp_path, text.replace("unknown g(y) by mlp(2, activation=silu)\n", ""))
    assert "extensions" not in yaml.safe_load(problem.read_text())
    found = import_file(problem, tmp_path / "again")
    assert found.data is not None
    assert gbspec.evaluate(found.model, found.data).nllh == pytest.approx(nllh, rel=1e-8)


def test_splines_are_refused(tmp_path: Path) -> None:
    text = MODEL.replace("unknown g(y) by mlp(2, activation=silu)", "unknown g(y in [0, 2]) by spline(4)")
    with pytest.raises(UserError, match="a spline"):
        exported(tmp_path, text)
