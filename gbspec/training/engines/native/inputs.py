"""The inputs of the native kernel as functions of the trainable vector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import NUMBER_WORDS, Library, NetworkLayers, Struct, network_layers
from gbspec.training.engines.arithmetic import lags, torch_arithmetic
from gbspec.training.engines.deliveries import delivered
from gbspec.training.engines.starting import initial_states
from gbspec.training.problem import Parameters, Problem


@dataclass(frozen=True)
class KernelInputs:
    """The kernel's inputs, as functions of the trainable vector.

    `weights` [W], the effective weights of all layers; `constants` [N, n_constants]; `initial` [N, n_states]; `amounts`
    and `times` [E] of the doses that arrive; `lags` [N, n_lags], the times of delays; `numbers`: scales that the forms
    of contracts use.
    """

    weights: Tensor
    constants: Tensor
    initial: Tensor
    amounts: Tensor
    times: Tensor
    lags: Tensor
    numbers: Array

    @classmethod
    def of(cls, problem: Problem, parameters: Parameters, vector: Tensor) -> KernelInputs:
        """The values at a vector, differentiable in it."""
        constants = parameters.constants(vector)
        called = () if problem.model.steady is None else problem.module.torch_networks(parameters.weights(vector))
        initial = initial_states(problem, parameters, vector, parameters.starts(vector), constants, called)
        networks = network_layers(problem.module, parameters.weights(vector), torch_arithmetic(problem.module))
        layers = _layer_weights(networks, vector)
        return cls(
            layers, constants, initial, *delivered(problem, constants), lags(problem, constants), _numbers(networks)
        )

    def struct(self, library: Library) -> Struct:
        """The kernel's argument: all inputs except the times, which are in the tables."""
        tensors = {name: getattr(self, name) for name in ("weights", "constants", "initial", "amounts", "lags")}
        arrays = {name: np.ascontiguousarray(x.detach().numpy()) for name, x in tensors.items()}
        return library.struct("Inputs", numbers=self.numbers, **arrays)


class Latest:
    """The inputs at the most recent vector, without derivatives: a plan and a solution at a vector need the same."""

    def __init__(self) -> None:
        self._kept: tuple[Problem, Parameters, Array, KernelInputs] | None = None

    def at(self, problem: Problem, parameters: Parameters, theta: Array) -> KernelInputs:
        """The inputs at a vector."""
        kept = self._kept
        if kept is None or not (kept[0] is problem and kept[1] is parameters and np.array_equal(kept[2], theta)):
            with torch.no_grad():
                found = KernelInputs.of(problem, parameters, torch.from_numpy(theta))
            kept = self._kept = problem, parameters, theta.copy(), found
        return kept[3]


def _layer_weights(networks: list[NetworkLayers], like: Tensor) -> Tensor:
    """All layers' weights and biases in the kernel's order, multiplied by the networks' scales."""
    parts = [part.reshape(-1) for network in networks for layer in network.folded for part in layer]
    return torch.cat(parts) if parts else like.new_zeros(0)


def _numbers(networks: list[NetworkLayers]) -> Array:
    """Centers and scales of outputs and scales of arguments, network by network."""
    names = {"center": "output_center", "scale": "output_scale", "input_scale": "input_scale"}
    parts = [getattr(network, names[word]).detach().numpy() for network in networks for word in NUMBER_WORDS]
    return np.concatenate([*(part.ravel() for part in parts), np.zeros(0)])
