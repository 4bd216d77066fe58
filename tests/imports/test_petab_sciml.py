"""import of PEtab-SciML: a small network in the right-hand side, against its closed form, and cases of the suite."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import gbspec
from gbspec.diagnostics import UserError
from gbspec.operations.importing import import_file
from tests.imports import models as made
from tests.imports.suites import suite

pytest.importorskip("libsbml", reason="SBML needs the extra `sbml`")
pytest.importorskip("yaml", reason="PEtab needs the extra `sbml`")
h5py = pytest.importorskip("h5py", reason="PEtab-SciML needs the extra `sbml`")
pytestmark = pytest.mark.usefixtures("quick_fits")

YAML = """\
format_version: 2.0.0
parameter_files: [parameters.tsv]
model_files: {one: {language: sbml, location: made.xml}}
condition_files: []
experiment_files: []
measurement_files: [measurements.tsv]
observable_files: [observables.tsv]
mapping_files: [mapping.tsv]
extensions:
  sciml:
    array_files: [net.hdf5]
    hybridization_files: [hybridization.tsv]
    neural_networks:
      net: {location: net.yaml, pre_initialization: false, format: YAML}
"""
NET = """\
nn_model_id: net
inputs: [{input_id: input0}]
layers:
- {layer_id: first, layer_type: Linear, args: {in_features: 1, out_features: 2, bias: true}}
- {layer_id: last, layer_type: Linear, args: {in_features: 2, out_features: 1, bias: false}}
forward:
- {name: x, op: placeholder, target: x, args: []}
- {name: first, op: call_module, target: first, args: [x]}
- {name: relu, op: call_function, target: relu, args: [first]}
- {name: last, op: call_module, target: last, args: [relu]}
- {name: output, op: output, target: output, args: [last]}
"""
TABLES = {
    "mapping": "petabEntityId\tmodelEntityId\nx0\tnet.inputs[0][0]\nout\tnet.outputs[0][0]\nps\tnet.parameters\n"
    "ps_last\tnet.parameters[last].weight\n",
    "hybridization": "targetId\ttargetValue\nx0\ty\nk\tout\n",
    "measurements": "observableId\texperimentId\ttime\tmeasurement\no\t\t1\t0.7\n",
    "observables": "observableId\tobservableFormula\tnoiseFormula\no\ty\t0.5\n",
    "parameters": "parameterId\tlowerBound\tupperBound\tnominalValue\testimate\tpriorDistribution\tpriorParameters\n"
    "ps\t-inf\tinf\tarray\ttrue\tnormal\t0;2\nps_last\t-inf\tinf\tarray\tfalse\t\t\n",
}


def problem(folder: Path, net: str = NET) -> Path:
    """y' = -k from 1, in which k is a network of y: 0.5*max(0, 0.8*y) + 3*max(0, -y) = 0.4*y while y > 0."""
    made.stored(folder, made.sbml(made.parameters("false", y="1", k="1"), made.rules(y=made.apply("minus", "k"))))
    for name, text in TABLES.items():
        (folder / f"{name}.tsv").write_text(text)
    (folder / "net.yaml").write_text(net)
    with h5py.File(folder / "net.hdf5", "w") as file:
        file["parameters/net/first/weight"] = np.array([[0.8], [-1.0]])
        file["parameters/net/first/bias"] = np.zeros(2)
        file["parameters/net/last/weight"] = np.array([[0.5, 3.0]])
    (folder / "problem.yaml").write_text(YAML)
    return folder / "problem.yaml"


def test_a_network_in_the_right_hand_side(tmp_path: Path) -> None:
    found = import_file(problem(tmp_path), tmp_path / "out")
    text = Path(found.model).read_text()
    assert "learn net_first_weight_0_0 = 0.8 prior normal(0, 2)" in text
    assert "const net_last_weight_0_1 = 3" in text
    assert found.data is not None
    result = gbspec.evaluate(found.model, found.data)
    residual = (math.exp(-0.4) - 0.7) / 0.5
    assert result.nllh == pytest.approx(0.5 * math.log(2 * math.pi * 0.25) + 0.5 * residual**2, rel=1e-8)
    slope = residual / 0.5 * -0.5 * math.exp(-0.4)
    assert result.gradient["net_first_weight_0_0"] == pytest.approx(slope, rel=1e-6)
    assert result.gradient["net_first_weight_1_0"] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("layer_type: Linear, args: {in_features: 1", "layer_type: GRU, args: {in_features: 1", "`GRU` is not"),
        ("target: relu", "target: erf", "`erf` is not offered"),
        ("args: [relu]", "args: [nothing]", "`nothing` has no value"),
    ],
)
def test_what_has_no_form_is_refused(tmp_path: Path, old: str, new: str, reason: str) -> None:
    with pytest.raises(UserError, match=reason):
        import_file(problem(tmp_path, NET.replace(old, new)), tmp_path / "out")


@pytest.mark.parametrize("case", ["007", "023", "037"])
def test_cases_of_the_suite(case: str) -> None:
    """A network in a start, a frozen layer, an input from an array file."""
    from benchmarks.studies.petab_sciml import judged

    assert judged(suite("petab_sciml") / case).end == "passed"
