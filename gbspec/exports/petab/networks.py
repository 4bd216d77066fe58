"""Networks by PEtab-SciML: the layers in YAML, the weights in HDF5, and what joins them to the model.

A network stands in the problem with its weights, which other programs may learn; what its arguments are, with their
scaling, is in the hybridization table, and its outputs take the place of constants of the SBML model. A network that is
applied more than once has one application as a PEtab network only, and so is written in formulas, as in SBML.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from gbspec.backends import Call, NetworkNumbers, NotCoveredError
from gbspec.exports.petab.tables import table
from gbspec.exports.sbml import Applications, Steps
from gbspec.exports.subject import Exported

if TYPE_CHECKING:
    from gbspec.exports.sbml import Names

_KNOWN = frozenset({"tanh", "relu", "sigmoid", "softplus", "silu"})
"""Activations that have the same name in PEtab-SciML, as in PyTorch."""


class AgainError(Exception):
    """A network is applied a second time; `network` is its index."""

    def __init__(self, network: int) -> None:
        super().__init__(network)
        self.network = network


@dataclass(frozen=True)
class Hybrid:
    """A network of the problem: the formulas of its inputs, and the model's constants that its outputs are."""

    name: str
    activation: str
    numbers: NetworkNumbers
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class Networks(Applications):
    """The applications of a model's unknowns; those in `formulas` (indices) are written out."""

    def __init__(self, exported: Exported, names: Names, formulas: frozenset[int]) -> None:
        super().__init__(exported, names)
        self._formulas = formulas
        self.found: dict[int, Hybrid] = {}

    def _network(self, step: Call, arguments: Sequence[str], base: str, found: Steps) -> list[str]:
        network = self._exported.model.networks[step.network]
        numbers = self._exported.networks[step.network]
        if network.spline or network.layout is not None:
            raise NotCoveredError("it has a spline or a network with bounded weights, which PEtab-SciML does not have")
        if step.network in self._formulas or network.activation not in _KNOWN:
            return super()._network(step, arguments, base, found)
        if step.network in self.found:
            raise AgainError(step.network)
        name = self._names.free(f"{numbers.name}_network")
        inputs = tuple(
            f"(({a}) - ({float(c)!r}))/({float(s)!r})"
            for a, c, s in zip(arguments, numbers.input_center, numbers.input_scale, strict=True)
        )
        outputs = tuple(self._names.free(f"{name}_output{i + 1}") for i in range(len(numbers.layers[-1][1])))
        self.found[step.network] = Hybrid(name, network.activation, numbers, inputs, outputs)
        if numbers.raw:
            return list(outputs)
        made = []
        for output, scale, center in zip(outputs, numbers.output_scale, numbers.output_center, strict=True):
            scaled = self._names.free(f"{output}_scaled")
            found.append((scaled, f"({float(center)!r}) + ({float(scale)!r})*{output}"))
            made.append(scaled)
        return made


def files(networks: Sequence[Hybrid]) -> dict[str, bytes]:
    """The files of all networks, by name; none without networks."""
    if not networks:
        return {}
    mapping, targets = [], []
    made = {f"{one.name}.yaml": _layers(one) for one in networks}
    for one in networks:
        for k, text in enumerate(one.inputs):
            mapping.append((f"{one.name}_input{k + 1}", f"{one.name}.inputs[0][{k}]"))
            targets.append((f"{one.name}_input{k + 1}", text))
        for k, target in enumerate(one.outputs):
            mapping.append((f"{one.name}_value{k + 1}", f"{one.name}.outputs[0][{k}]"))
            targets.append((target, f"{one.name}_value{k + 1}"))
        mapping.append((f"{one.name}_weights", f"{one.name}.parameters"))
    made["mapping.tsv"] = table(("petabEntityId", "modelEntityId"), mapping)
    made["hybridization.tsv"] = table(("targetId", "targetValue"), targets)
    made["weights.hdf5"] = _arrays(networks)
    return made


def extension(networks: Sequence[Hybrid]) -> dict[str, Any]:
    """The parts of the problem's document that name these files."""
    if not networks:
        return {}
    known = {
        one.name: {"location": f"{one.name}.yaml", "pre_initialization": False, "format": "YAML"} for one in networks
    }
    sciml = {
        "version": "0.1.0",
        "required": True,
        "array_files": ["weights.hdf5"],
        "hybridization_files": ["hybridization.tsv"],
        "neural_networks": known,
    }
    return {"mapping_files": ["mapping.tsv"], "extensions": {"sciml": sciml}}


def weights(networks: Sequence[Hybrid]) -> list[tuple[str, ...]]:
    """The rows of the parameter table: all weights are estimated, from those in the file."""
    return [(f"{one.name}_weights", "", "-inf", "inf", "array", "true", "", "") for one in networks]


def _layers(one: Hybrid) -> bytes:
    layers, forward = [], [_node("net_input", "placeholder", "net_input", [])]
    last = "net_input"
    for i, (weight, _) in enumerate(one.numbers.layers, 1):
        size = {"in_features": int(weight.shape[1]), "out_features": int(weight.shape[0]), "bias": True}
        layers.append({"layer_id": f"layer{i}", "layer_type": "Linear", "args": size})
        forward.append(_node(f"layer{i}", "call_module", f"layer{i}", [last]))
        last = f"layer{i}"
        if i < len(one.numbers.layers):
            forward.append(_node(f"{one.activation}_{i}", "call_function", one.activation, [last]))
            last = f"{one.activation}_{i}"
    forward.append(_node("output", "output", "output", [last]))
    document = {
        "nn_model_id": one.name,
        "inputs": [{"input_id": "input0"}],
        "layers": layers,
        "forward": forward,
    }
    return str(yaml.safe_dump(document, sort_keys=False)).encode()


def _node(name: str, op: str, target: str, arguments: list[str]) -> dict[str, Any]:
    return {"name": name, "op": op, "target": target, "args": arguments, "kwargs": {}}


def _arrays(networks: Sequence[Hybrid]) -> bytes:
    import h5py

    out = io.BytesIO()
    with h5py.File(out, "w", track_order=True) as file:
        file["metadata/pytorch_format"] = True
        for one in networks:
            for i, (weight, bias) in enumerate(one.numbers.layers, 1):
                for kind, array in (("weight", weight), ("bias", bias)):
                    file[f"parameters/{one.name}/layer{i}/{kind}"] = np.asarray(array, dtype=np.float64)
    return out.getvalue()
