"""The networks of a generated module as lists of layers, for code that evaluates them in another way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.arrays import Array
from gbspec.backends.module.template.networks import _folded, _layers, _torch_like
from gbspec.backends.protocol import Arithmetic, GeneratedModule

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class NetworkLayers:
    """A network at given weights: `layers`, weights [out, in] and biases [out] after the sign constraints of contracts,
    and its scales. With `raw` outputs, the forms of contracts apply the output scales."""

    name: str
    raw: bool
    layers: list[tuple[Tensor, Tensor]]
    input_center: Tensor
    input_scale: Tensor
    output_center: Tensor
    output_scale: Tensor

    @property
    def folded(self) -> list[tuple[Tensor, Tensor]]:
        """The layers with the scales multiplied into the first and, unless the outputs are raw, the last."""
        scales = (self.input_center, self.input_scale, self.output_center, self.output_scale)
        return _folded({"raw": self.raw}, self.layers, scales)


def network_layers(module: GeneratedModule, weights: Mapping[str, Tensor], ops: Arithmetic) -> list[NetworkLayers]:
    """The networks of a generated module (a class or an instance) at weights by name; `ops` is its torch arithmetic."""
    found = []
    for network in module.networks:
        layers, scales = _layers(network, weights, ops, _torch_like)
        found.append(NetworkLayers(network["name"], bool(network["raw"]), layers, *scales))
    return found


@dataclass(frozen=True)
class NetworkNumbers:
    """What `NetworkLayers` has, at an instance's own weights as arrays, and the range [in] of each argument that it
    learned from: the trained one, else the declared one, else infinite."""

    name: str
    raw: bool
    layers: list[tuple[Array, Array]]
    input_center: Array
    input_scale: Array
    output_center: Array
    output_scale: Array
    low: Array
    high: Array


def network_numbers(instance: GeneratedModule) -> list[NetworkNumbers]:
    """The networks of an instance as numbers; torch is not needed."""
    found = []
    ops = instance.arithmetic("numpy")
    for network in instance.networks:
        layers, scales = _layers(network, instance.weights, ops, lambda value, _: value)
        declared = [(-np.inf, np.inf) if ends is None else ends for ends in network["ranges"]]
        prefix, (low, high) = f"network.{network['name']}.", np.array(declared, dtype=np.float64).T
        low, high = instance.weights.get(f"{prefix}input_low", low), instance.weights.get(f"{prefix}input_high", high)
        plain = [(np.asarray(weight, dtype=np.float64), np.asarray(bias, dtype=np.float64)) for weight, bias in layers]
        center, scale, output_center, output_scale = scales
        found.append(
            NetworkNumbers(
                network["name"], bool(network["raw"]), plain, center, scale, output_center, output_scale, low, high
            )
        )
    return found
