"""Multilayer perceptrons in three libraries. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

import functools
import math as _math
from typing import Any

import numpy as np

from gbspec.backends.module.template.arithmetic import _arithmetic, _numpy_arithmetic, _torch_arithmetic
from gbspec.backends.module.template.directions import _activations, _weight_forms

# <body>
# ---------------------------------------------------------------------- networks
# A network is called with separate arguments and returns a tuple of its outputs:
# output_center + output_scale*mlp((arguments - input_center)/input_scale), a hidden layer being activation(W a + b).


@functools.cache
def _torch_activation(name: str) -> Any:
    import torch
    from torch.nn import functional

    table = {
        "silu": functional.silu,
        "tanh": torch.tanh,
        "softplus": lambda z: functional.softplus(z, threshold=40.0),  # torch's default of 20 loses five digits
        "relu": torch.relu,
        "gelu": functional.gelu,
        "sigmoid": torch.sigmoid,
        "elu": functional.elu,
        "sin": torch.sin,
    }
    return table[name]


def _activation(library: str, name: str) -> Any:
    """The activation for casadi or numpy; arguments of exp are bounded so that nothing overflows."""
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


def _layers(network: dict[str, Any], weights: Any, m: Any, like: Any) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    """Weights and biases of each layer; input center and scale, output center and scale."""
    prefix = f"network.{network['name']}."
    layers = [(weights[f"{prefix}{i}.weight"], weights[f"{prefix}{i}.bias"]) for i in range(len(network["sizes"]) - 1)]
    if network["layout"] is not None:
        for i, (free, gain, sharpness, turned) in enumerate(_weight_forms(network["layout"], network["sizes"])):
            weight, bias = layers[i]
            given = like(gain, weight) * m.softplus(sharpness * weight)
            layers[i] = like(free, weight) * weight + given, like(turned, bias) * bias
    names = ("input_center", "input_scale", "output_center", "output_scale")
    return layers, tuple(weights[prefix + name] for name in names)


class _Raw:
    """A network with unscaled outputs; a contract's form applies their centers and scales (lists of numbers)."""

    def __init__(self, call: Any, center: Any, scale: Any, input_scale: Any) -> None:
        self.call = call
        self.center, self.scale, self.input_scale = center.tolist(), scale.tolist(), input_scale.tolist()

    def __call__(self, *arguments: Any) -> Any:
        return self.call(*arguments)


def _folded(network: dict[str, Any], layers: Any, scales: tuple[Any, ...]) -> list[tuple[Any, Any]]:
    """Torch layers with a network's scales multiplied into the first and the last; with raw outputs only the first."""
    center, scale, output_center, output_scale = scales
    (weight, bias), folded = layers[0], list(layers)
    folded[0] = (weight / scale, bias - (weight / scale) @ center)
    if not network["raw"]:
        weight, bias = folded[-1]
        folded[-1] = (output_scale[:, None] * weight, output_scale * bias + output_center)
    return folded


class _TorchNetwork:
    """A network over torch tensors; its scales are folded into the first and the last layer once.

    `layers`: weights [in, out] and biases including the scales; `activations`: that of each hidden layer.
    """

    def __init__(self, layers: Any, activations: Any, together: Any) -> None:
        self.layers = [(weight.T, bias) for weight, bias in layers]
        self.activations, self._together = activations, together

    def __call__(self, *arguments: Any) -> Any:
        points = self._together(arguments)
        if points.ndim == 2:
            return self.through(self.layers, points).unbind(-1)
        out = self.through(self.layers, points.reshape(-1, points.shape[-1]))
        return out.reshape(*points.shape[:-1], out.shape[-1]).unbind(-1)

    def through(self, layers: Any, points: Any) -> Any:
        """The outputs [B, out] of the given layers, with its activations, at points [B, in]; biases are [width] or
        [B, width]."""
        import torch

        a = points
        for i, (weight, bias) in enumerate(layers):
            a = torch.addmm(bias, self.activations[i - 1](a) if i else a, weight)
        return a


def _torch_network(network: dict[str, Any], weights: Any, index: int, tape: list[Any] | None) -> Any:
    import torch
    from torch.nn.functional import linear

    m = _torch_arithmetic()
    own = _torch_activation(network["activation"])
    activations = _activations(network, own, m, _torch_split, lambda parts: torch.cat(parts, -1))
    layers, scales = _layers(network, weights, m, _torch_like)
    center, scale, output_center, output_scale = scales
    raw, shape = network["raw"], [()]

    def together(arguments: Any) -> Any:
        if not any(isinstance(a, torch.Tensor) for a in arguments):  # one point, such as that of a `zero` contract
            point = torch.stack([center.new_tensor(float(a)) for a in arguments])
            return point if tape is None else point.expand(*shape[0], len(arguments))
        stacked = _torch_like(_stack(m.pack, arguments), center)
        shape[0] = stacked.shape[:1] if stacked.ndim > 1 else ()  # with a tape there is one batch axis
        return stacked

    def taped(*arguments: Any) -> Any:
        z = (together(arguments) - center) / scale
        for i, (weight, bias) in enumerate(layers):
            a = activations[i - 1](z) if i else z
            z = linear(a, weight, bias)
            if tape is not None:
                tape.append((index, i, a, z))
        return (z if raw else output_center + output_scale * z).unbind(-1)

    call = taped if tape is not None else _TorchNetwork(_folded(network, layers, scales), activations, together)
    # [algebraic
    if tape is not None:  # the search for algebraic variables records nothing
        made: Any = _Raw(call, output_center, output_scale, scale) if raw else call
        made.quiet = _torch_network(network, weights, index, None)
        return made
    # algebraic]
    return _Raw(call, output_center, output_scale, scale) if raw else call


def _torch_split(z: Any, sizes: list[int]) -> list[Any]:
    """Parts along the last axis, each contiguous: activations of strided parts take twice as long."""
    return [part.contiguous() for part in z.split(sizes, -1)]


def _torch_like(value: Any, like: Any) -> Any:
    """An array as a tensor of the type and on the device of another."""
    import torch

    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def _stack(pack: Any, arguments: Any) -> Any:
    """Arguments stacked along a new last axis; their shapes broadcast, and numbers become tensors."""
    import torch

    first, shape = arguments[0], np.broadcast_shapes(*(getattr(a, "shape", ()) for a in arguments))
    if all(isinstance(a, torch.Tensor) and a.shape == shape for a in arguments):
        return torch.stack(arguments, -1)
    like = next((a for a in arguments if isinstance(a, torch.Tensor)), torch.as_tensor(first, dtype=torch.float64))
    return pack(like.expand(shape)[..., None], arguments)


def _numpy_network(network: dict[str, Any], weights: Any) -> Any:
    m = _numpy_arithmetic()
    layers, (center, scale, output_center, output_scale) = _layers(network, weights, m, lambda value, _: value)
    activations = _activations(
        network,
        _activation("numpy", network["activation"]),
        m,
        lambda z, sizes: np.split(z, np.cumsum(sizes)[:-1], -1),
        lambda parts: np.concatenate(parts, -1),
    )

    def call(*arguments: Any) -> Any:
        like = np.zeros((*np.broadcast_shapes(*map(np.shape, arguments)), 1))
        a = (m.pack(like, arguments) - center) / scale
        for i, (weight, bias) in enumerate(layers):
            a = (activations[i - 1](a) if i else a) @ weight.T + bias
        return tuple(np.moveaxis(a if network["raw"] else output_center + output_scale * a, -1, 0))

    return _Raw(call, output_center, output_scale, scale) if network["raw"] else call


def _casadi_network(network: dict[str, Any], weights: Any) -> Any:
    import casadi as ca

    layers, (center, scale, output_center, output_scale) = _layers(
        network, weights, _numpy_arithmetic(), lambda value, _: value
    )
    activations = _activations(
        network,
        _activation("casadi", network["activation"]),
        _arithmetic("casadi"),
        lambda z, sizes: ca.vertsplit(z, [0, *np.cumsum(sizes).tolist()]),
        lambda parts: ca.vertcat(*parts),
    )

    def repeated(column: Any, count: int) -> Any:
        return ca.repmat(ca.DM(column), 1, count)

    def call(*arguments: Any) -> Any:
        count = max(getattr(argument, "shape", (1,))[0] for argument in arguments)  # of points, one per column
        rows = [ca.repmat(a, 1, count) if getattr(a, "shape", (1,))[0] == 1 else a.T for a in arguments]
        a = (ca.vertcat(*rows) - repeated(center, count)) / repeated(scale, count)
        for i, (weight, bias) in enumerate(layers):
            a = ca.mtimes(ca.DM(weight), activations[i - 1](a) if i else a) + repeated(bias, count)
        out = a if network["raw"] else repeated(output_center, count) + repeated(output_scale, count) * a
        return tuple(row.T for row in ca.vertsplit(out))

    return _Raw(call, output_center, output_scale, scale) if network["raw"] else call


def _casadi_name(name: str) -> str:
    """A name that casadi accepts for a function: letters, digits and single underscores."""
    text = "".join(c if c.isascii() and c.isalnum() else "_" for c in name).strip("_")
    while "__" in text:
        text = text.replace("__", "_")
    return text if text[:1].isalpha() and text not in ("null", "jac", "hess") else f"f_{text}".rstrip("_")
