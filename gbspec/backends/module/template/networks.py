"""Multilayer perceptrons in three libraries. Everything above the line `# <body>` stays behind."""

from __future__ import annotations

import functools
import math as _math
from typing import Any

import numpy as np

from gbspec.backends.module.template.arithmetic import _arithmetic, _numpy_arithmetic, _torch_arithmetic

# <body>
# ---------------------------------------------------------------------- networks
# A network is called with its arguments one by one and returns a tuple of its outputs:
# output_center + output_scale*mlp((arguments - input_center)/input_scale), a hidden layer being activation(W a + b).


@functools.cache
def _torch_activation(name: str) -> Any:
    import torch
    from torch.nn import functional

    table = {
        "silu": functional.silu,
        "tanh": torch.tanh,
        "softplus": lambda z: functional.softplus(z, threshold=40.0),  # torch's own threshold, 20, costs five digits
        "relu": torch.relu,
        "gelu": functional.gelu,
        "sigmoid": torch.sigmoid,
        "elu": functional.elu,
        "sin": torch.sin,
    }
    return table[name]


def _activation(library: str, name: str) -> Any:
    """The activation for casadi or numpy; arguments of exp are kept where neither it nor its derivative overflows."""
    m = _arithmetic(library)
    expm1: Any
    log1p: Any
    erf: Any
    if library == "casadi":
        import casadi

        expm1, log1p, erf = casadi.expm1, casadi.log1p, casadi.erf
    else:
        expm1, log1p, erf = np.expm1, np.log1p, np.vectorize(_math.erf, otypes=[np.float64])
    table = {
        "silu": lambda z: z / (1.0 + m.exp(m.minimum(-z, 300.0))),
        "tanh": m.tanh,
        "softplus": lambda z: m.where(z > 40.0, z, log1p(m.exp(m.minimum(z, 40.0)))),
        "relu": lambda z: m.maximum(z, 0.0),
        "gelu": lambda z: 0.5 * z * (1.0 + erf(z / 2.0**0.5)),
        "sigmoid": lambda z: 1.0 / (1.0 + m.exp(m.minimum(-z, 300.0))),
        "elu": lambda z: m.where(z > 0.0, z, expm1(m.minimum(z, 0.0))),
        "sin": m.sin,
    }
    return table[name]


def _layers(network: dict[str, Any], weights: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    """Weights and biases layer by layer; input center and scale, output center and scale."""
    prefix = f"network.{network['name']}."
    layers = [(weights[f"{prefix}{i}.weight"], weights[f"{prefix}{i}.bias"]) for i in range(len(network["sizes"]) - 1)]
    names = ("input_center", "input_scale", "output_center", "output_scale")
    return layers, tuple(weights[prefix + name] for name in names)


def _torch_network(network: dict[str, Any], weights: Any, index: int, tape: list[Any] | None) -> Any:
    from torch.nn.functional import linear

    activation, pack = _torch_activation(network["activation"]), _torch_arithmetic().pack
    layers, (center, scale, output_center, output_scale) = _layers(network, weights)

    def taped(*arguments: Any) -> Any:
        z = (_stack(pack, arguments) - center) / scale
        for i, (weight, bias) in enumerate(layers):
            a = activation(z) if i else z
            z = linear(a, weight, bias)
            if tape is not None:
                tape.append((index, i, a, z))
        return (output_center + output_scale * z).unbind(-1)

    if tape is not None:
        return taped
    # The scales go into the first and the last layer once, instead of into every call.
    (weight, bias), folded = layers[0], list(layers)
    folded[0] = (weight / scale, bias - (weight / scale) @ center)
    weight, bias = folded[-1]
    folded[-1] = (output_scale[:, None] * weight, output_scale * bias + output_center)
    *hidden, (last_weight, last_bias) = folded

    def plain(*arguments: Any) -> Any:
        a = _stack(pack, arguments)
        for weight, bias in hidden:
            a = activation(linear(a, weight, bias))
        return linear(a, last_weight, last_bias).unbind(-1)

    return plain


def _stack(pack: Any, arguments: Any) -> Any:
    """Arguments along a new last axis; their shapes broadcast, numbers among them become tensors."""
    import torch

    first, shape = arguments[0], np.broadcast_shapes(*(getattr(a, "shape", ()) for a in arguments))
    if all(isinstance(a, torch.Tensor) and a.shape == shape for a in arguments):
        return torch.stack(arguments, -1)
    like = next((a for a in arguments if isinstance(a, torch.Tensor)), torch.as_tensor(first, dtype=torch.float64))
    return pack(like.expand(shape)[..., None], arguments)


def _numpy_network(network: dict[str, Any], weights: Any) -> Any:
    activation, pack = _activation("numpy", network["activation"]), _numpy_arithmetic().pack
    layers, (center, scale, output_center, output_scale) = _layers(network, weights)

    def call(*arguments: Any) -> Any:
        like = np.zeros((*np.broadcast_shapes(*map(np.shape, arguments)), 1))
        a = (pack(like, arguments) - center) / scale
        for i, (weight, bias) in enumerate(layers):
            a = (activation(a) if i else a) @ weight.T + bias
        return tuple(np.moveaxis(output_center + output_scale * a, -1, 0))

    return call


def _casadi_network(network: dict[str, Any], weights: Any) -> Any:
    import casadi as ca

    activation = _activation("casadi", network["activation"])
    layers, (center, scale, output_center, output_scale) = _layers(network, weights)

    def call(*arguments: Any) -> Any:
        a = (ca.vertcat(*arguments) - ca.DM(center)) / ca.DM(scale)
        for i, (weight, bias) in enumerate(layers):
            a = ca.mtimes(ca.DM(weight), activation(a) if i else a) + ca.DM(bias)
        return tuple(ca.vertsplit(ca.DM(output_center) + ca.DM(output_scale) * a))

    return call
