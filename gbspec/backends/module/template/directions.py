"""Networks that are monotone in some arguments. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np

# <body>
# ---------------------------------------------------------------------- directions
# Contracts that need a network monotone or bent in an argument constrain the signs of weights. A unit has a kind, one
# character per argument, with properties of its own: non-decreasing (i), non-increasing (d), convex (x), concave (c).
# A weight with a given sign is sign*gain*softplus(sharpness*w), where w is trained; one that would violate a kind is
# omitted. Arguments themselves are straight (l).
# Concave units, -softplus(-z), are computed as softplus(z) with the signs of their weights reversed.

_PROPERTIES = {
    "0": "idxc",
    "*": "",
    "+": "i",
    "-": "d",
    "l": "ixc",
    "m": "dxc",
    "x": "x",
    "c": "c",
    "p": "xi",
    "q": "xd",
    "r": "ci",
    "s": "cd",
}
_TURNED = str.maketrans("+-lmxcpqrs", "-+mlcxsrqp")


def _fits(kind: str, into: str) -> bool:
    """Whether a unit of one kind may feed one of another with a positive weight."""
    return all(set(_PROPERTIES[b]) <= set(_PROPERTIES[a]) for a, b in zip(kind, into, strict=True))


@functools.cache
def _weight_forms(layout: Any, sizes: tuple[int, ...]) -> tuple[tuple[Any, Any, float, Any], ...]:
    """For each layer (free, gain, sharpness, turned): weight = free*w + gain*softplus(sharpness*w), bias = turned*b."""
    hidden, outputs = layout
    n = sizes[0]
    layers = [[("0" * i + "l" + "0" * (n - i - 1), 1.0) for i in range(n)]]
    layers += [
        [(kind, -1.0 if shape == "concave" else 1.0) for kind, shape, count in blocks for _ in range(count)]
        for blocks in hidden
    ]
    layers.append([(kind, 1.0) for kind in outputs])
    forms = []
    for i, (below, above) in enumerate(itertools.pairwise(layers)):
        positive = np.array([[_fits(kind, into) for kind, _ in below] for into, _ in above])
        negative = np.array([[_fits(kind.translate(_TURNED), into) for kind, _ in below] for into, _ in above])
        turned = np.array([sign for _, sign in above])
        signs = turned[:, None] * np.array([sign for _, sign in below])
        given = positive != negative
        sharpness = 1.6 * len(below) ** 0.5
        # The initial weights of the first layer are about as large as free ones; later layers, whose weights have one
        # sign, begin with a mean of their inputs, the last with less, so that initial slopes are small.
        gain = 1.0 / sharpness if i == 0 else 1.2 / np.maximum(given.sum(1, keepdims=True), 1)
        gain = gain * (0.3 if i == len(layers) - 2 else 1.0)
        forms.append(
            (signs * (positive & negative), signs * gain * given * np.where(positive, 1, -1), sharpness, turned)
        )
    return tuple(forms)


def _weight_slopes(network: dict[str, Any], weights: Any) -> dict[str, Any]:
    """Derivatives of the weights that a network uses with respect to the trained ones."""
    slopes = {}
    for i, (free, gain, sharpness, turned) in enumerate(_weight_forms(network["layout"], network["sizes"])):
        name = f"network.{network['name']}.{i}."
        raw = np.asarray(weights[name + "weight"], dtype=np.float64)
        slopes[name + "weight"] = free + sharpness * gain / (1.0 + np.exp(np.minimum(-sharpness * raw, 300.0)))
        slopes[name + "bias"] = turned
    return slopes


def _shares(blocks: Any) -> tuple[int, int, int]:
    """The numbers of units with the network's activation, a convex or concave one, and a bounded one."""
    count = {shape: sum(n for _, s, n in blocks if s == shape) for shape in ("free", "convex", "concave", "saturating")}
    return count["free"], count["convex"] + count["concave"], count["saturating"]


def _activations(network: dict[str, Any], own: Any, m: Any, split: Any, join: Any) -> list[Any]:
    """The activation of each hidden layer."""
    if network["layout"] is None:
        return [own] * (len(network["sizes"]) - 2)

    def mixed(sizes: tuple[int, int, int]) -> Any:
        used = [(function, size) for function, size in zip((own, m.softplus, m.tanh), sizes, strict=True) if size]
        if len(used) == 1:
            return used[0][0]
        functions, counts = [function for function, _ in used], [size for _, size in used]
        return lambda z: join([f(part) for f, part in zip(functions, split(z, counts), strict=True)])

    return [mixed(_shares(blocks)) for blocks in network["layout"][0]]
