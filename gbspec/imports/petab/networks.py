"""Networks of PEtab-SciML as formulas: each weight is a constant of the model, learned or fixed, each unit a `let`.

So the likelihood, its gradient by every weight, frozen layers and priors are those of the problem. A network of PEtab
has no scaling of its arguments by data, which those of `unknown … by mlp` have, and may stand in a start.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gbspec.arrays import Array
from gbspec.imports.formulas import ZERO, Formula, call, named, number
from gbspec.imports.petab.layers import (
    Formulas,
    NotOfferedLayerError,
    array,
    convolved,
    flattened,
    linear,
    pooled,
)
from gbspec.imports.petab.problem import MOST_TABLE, MOST_YAML, Row, files_of
from gbspec.imports.petab.second import Second
from gbspec.imports.safety import read_file, refused

MOST_WEIGHTS = 3000
"""The largest network that is written as formulas."""
MOST_ENTRIES = 2000
"""The largest array that is an input; each entry is a condition, a column of the table."""
_ENTITY = re.compile(r"(\w+)\.(inputs|outputs)\[(\d+)\](?:\[(\d+)\])?$")
_PARAMETERS = re.compile(r"(\w+)\.parameters(?:\[(\w+)\])?(?:\.(weight|bias))?$")


def _logistic(x: Formula) -> Formula:
    return Formula("/", (number(1), number(1) + call("exp", -x)))


_ACTIVATIONS: dict[str, Callable[[Formula], Formula]] = {
    "tanh": lambda x: call("tanh", x),
    "relu": lambda x: call("max", ZERO, x),
    "sigmoid": _logistic,
    "softplus": lambda x: call("log", number(1) + call("exp", x)),
    "silu": lambda x: x * _logistic(x),
}
_MODULES = {"Tanh": "tanh", "ReLU": "relu", "Sigmoid": "sigmoid", "Softplus": "softplus", "SiLU": "silu"}


@dataclass(frozen=True)
class Weight:
    """A weight: its name, its value, and where it stands."""

    name: str
    value: float
    network: str
    layer: str
    kind: str


@dataclass
class Networks:
    """The networks of a problem: weights, units (as `lets`), and which entities of the mapping are what.

    `hybrid` has what the hybridization says of other quantities; `arrays` constants of array inputs, a number for
    each condition, or one for all under the name `0`."""

    weights: list[Weight] = field(default_factory=list)
    lets: dict[str, Formula] = field(default_factory=dict)
    hybrid: dict[str, str] = field(default_factory=dict)
    arrays: dict[str, dict[str, float]] = field(default_factory=dict)
    scopes: dict[str, tuple[str, str, str]] = field(default_factory=dict)
    """Network, layer and kind of weights by the entity of the mapping; empty texts stand for all."""

    def governing(self, weight: Weight, rows: Sequence[Row]) -> Row | None:
        """The row of the parameter table that says most of a weight."""
        best: tuple[int, Row] | None = None
        for row in rows:
            scope = self.scopes.get(row.get("parameterId", ""))
            if scope is None or scope[0] != weight.network:
                continue
            if scope[1] in ("", weight.layer) and scope[2] in ("", weight.kind):
                rank = bool(scope[1]) + bool(scope[2])
                best = (rank, row) if best is None or rank > best[0] else best
        return None if best is None else best[1]


def read_networks(path: Path, second: Second, rows: Sequence[Row], parse: Any) -> Networks:
    """The networks of a problem; `rows` are those of the hybridization. Raises `UserError` (GB894)."""
    found = Networks()
    inputs: dict[tuple[str, int, int], str] = {}
    outputs: dict[tuple[str, int, int], str] = {}
    for row in second.mapping:
        entity, model = row.get("petabEntityId", ""), row.get("modelEntityId", "")
        place, scope = _ENTITY.match(model), _PARAMETERS.match(model)
        if place is not None:
            table = inputs if place[2] == "inputs" else outputs
            table[place[1], int(place[3]), -1 if place[4] is None else int(place[4])] = entity
        elif scope is not None:
            found.scopes[entity] = (scope[1], scope[2] or "", scope[3] or "")
    values = {row.get("targetId", ""): row.get("targetValue", "") for row in rows}
    entities = {*inputs.values()}
    found.hybrid = {k: v for k, v in values.items() if k not in entities}
    arrays = _arrays(path, second)
    given = second.sciml.get("neural_networks")
    for name, one in (given if isinstance(given, dict) else {}).items():
        if not isinstance(one, dict) or one.get("format") != "YAML":
            raise refused(path, f"the network `{name}` is not written in YAML, which alone is offered")
        document = _yaml(files_of(path, [one.get("location")])[0])
        groups = _inputs(path, str(name), inputs, values, arrays, found, parse)
        result = _Forward(path, str(name), document, arrays, found).run(groups)
        for (network, _, j), entity in outputs.items():
            if network == name:
                if not 0 <= j < len(result):
                    raise refused(path, f"the network `{name}` has no output {j}")
                found.lets[entity] = result[j]
    if len(found.weights) > MOST_WEIGHTS:
        raise refused(path, f"its networks have {len(found.weights)} weights; {MOST_WEIGHTS} are offered")
    return found


def _yaml(path: Path) -> dict[str, Any]:
    try:
        document: Any = yaml.safe_load(read_file(path, MOST_YAML).decode("utf-8", errors="replace"))
    except (yaml.YAMLError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise refused(path, "it is no network in YAML")
    return document


def _arrays(path: Path, second: Second) -> dict[str, Array]:
    """All arrays of the problem's HDF5 files, by their names."""
    import h5py

    found: dict[str, Array] = {}

    def keep(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and item.size and item.dtype.kind in "fiu":
            found[name] = np.asarray(item[()], dtype=np.float64)

    for place in files_of(path, second.sciml.get("array_files")):
        read_file(place, MOST_TABLE)  # so that its size is looked at
        try:
            with h5py.File(place, "r") as file:
                file.visititems(keep)
        except OSError as error:
            raise refused(place, f"it is no HDF5 file: {error}") from None
    return found


def _inputs(
    path: Path,
    name: str,
    places: Mapping[tuple[str, int, int], str],
    values: Mapping[str, str],
    arrays: Mapping[str, Array],
    found: Networks,
    parse: Any,
) -> list[Formulas]:
    """The formulas of a network's inputs, an array of each."""
    groups: dict[int, dict[int, Formula]] = {}
    arrayed: dict[int, Formulas] = {}
    for (network, i, j), entity in places.items():
        if network != name:
            continue
        text = values.get(entity, entity)
        if text != "array":
            groups.setdefault(i, {})[max(j, 0)] = parse(text)
            continue
        mine = {key.split("/")[-1]: a for key, a in arrays.items() if key.startswith(f"inputs/{entity}/")}
        sizes = {a.shape for a in mine.values()}
        if len(sizes) != 1:
            raise refused(path, f"the input `{entity}` has no array, or arrays of several shapes")
        whole = np.empty(next(iter(sizes)), dtype=object)
        if whole.size > MOST_ENTRIES:
            raise refused(path, f"the input `{entity}` has {whole.size} entries; {MOST_ENTRIES} are offered")
        for place in np.ndindex(*whole.shape):
            constant = "_".join((entity, *map(str, place)))
            found.arrays[constant] = {key: float(a[place]) for key, a in mine.items()}
            whole[place] = named(constant)
        arrayed[i] = whole
    vectors = {i: array([group[j] for j in sorted(group)]) for i, group in groups.items()}
    return [both[i] for both in (vectors | arrayed,) for i in sorted(both)]


class _Forward:
    """The forward pass of one network, in formulas."""

    def __init__(self, path: Path, name: str, document: dict[str, Any], arrays: Mapping[str, Array], found: Networks):
        self.path, self.name, self.arrays, self.found = path, name, arrays, found
        layers = document.get("layers")
        self.layers = {str(one.get("layer_id")): one for one in layers if isinstance(one, dict)} if layers else {}
        self.nodes = [one for one in document.get("forward") or () if isinstance(one, dict)]
        self.values: dict[str, Formulas] = {}

    def run(self, groups: list[Formulas]) -> list[Formula]:
        """The outputs."""
        left: Iterator[Formulas] = iter(groups)
        for node in self.nodes:
            op, target, name = str(node.get("op")), str(node.get("target")), str(node.get("name"))
            args = [self._argument(one) for one in node.get("args") or () if isinstance(one, str | list)]
            if op == "placeholder":
                value = next(left, None)
                if value is None:
                    raise self._refused(f"the input `{name}` has no value")
                self.values[name] = value
            elif op == "output":
                return list(args[0].ravel())
            elif op == "call_module":
                self.values[name] = self._layer(target, args[0])
            elif target == "cat":
                self.values[name] = args[0]
            elif target == "flatten":
                given = node.get("args") or []
                places = [one for one in given if isinstance(one, int)]
                self.values[name] = flattened(args[0], dict(zip(("start_dim", "end_dim"), places, strict=False)))
            elif target in _ACTIVATIONS:
                self.values[name] = _each(_ACTIVATIONS[target], args[0])
            else:
                raise self._refused(f"the function `{target}` is not offered")
        raise self._refused("it has no output")

    def _argument(self, given: Any) -> Formulas:
        if isinstance(given, list):
            return array(list(itertools.chain.from_iterable(self._argument(one).ravel() for one in given)))
        if given not in self.values:
            raise self._refused(f"`{given}` has no value")
        return self.values[given]

    def _layer(self, layer: str, x: Formulas) -> Formulas:
        one = self.layers.get(layer, {})
        kind, args = str(one.get("layer_type")), one.get("args")
        args = args if isinstance(args, dict) else {}
        if kind in _MODULES:
            return _each(_ACTIVATIONS[_MODULES[kind]], x)
        if kind == "Dropout":
            return x  # which does nothing but in training
        try:
            match kind:
                case "Linear":
                    return linear(x, *self._weights(layer), lambda place, total: self._unit(layer, place, total))
                case "Conv2d":
                    weights = self._weights(layer)
                    return convolved(x, *weights, args, lambda place, total: self._unit(layer, place, total))
                case "MaxPool2d" | "AvgPool2d":
                    return pooled(x, kind, args)
                case "Flatten":
                    return flattened(x, args)
        except NotOfferedLayerError as problem:
            raise self._refused(f"the layer `{layer}`: {problem}") from None
        raise self._refused(f"the layer `{kind}` is not offered")

    def _unit(self, layer: str, place: str, total: Formula) -> Formula:
        """A sum under a name of its own."""
        unit = f"{self.name}_{layer}_{place}"
        self.found.lets[unit] = total
        return named(unit)

    def _weights(self, layer: str) -> tuple[Formulas, Formulas | None]:
        """The weights and the bias of a layer, as constants."""
        weight, bias = (self._named(layer, kind) for kind in ("weight", "bias"))
        if weight is None:
            raise self._refused(f"the layer `{layer}` has no weights")
        return weight, bias

    def _named(self, layer: str, kind: str) -> Formulas | None:
        values = self.arrays.get(f"parameters/{self.name}/{layer}/{kind}")
        if values is None:
            return None
        made = np.empty(values.shape, dtype=object)
        for place, value in np.ndenumerate(values):
            name = "_".join((self.name, layer, kind, *map(str, place)))
            self.found.weights.append(Weight(name, float(value), self.name, layer, kind))
            made[place] = named(name)
        return made

    def _refused(self, reason: str) -> Exception:
        return refused(self.path, f"the network `{self.name}`: {reason}")


def _each(function: Callable[[Formula], Formula], x: Formulas) -> Formulas:
    return array([function(one) for one in x.ravel()]).reshape(x.shape)
