"""Shapes, checks and random values of weights. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

# <body>
# ---------------------------------------------------------------------- weights


def _array(value: Any) -> Any:
    """Numbers, an array or a tensor (on any device, with or without a gradient) as a float64 array."""
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value, dtype=np.float64)


def _required_shapes(module: Any) -> dict[str, tuple[int, ...]]:
    """The names and shapes of the weights that a model must have."""
    table: dict[str, tuple[int, ...]] = {"constants": (len(module.constants),)}
    for network in module.networks:
        prefix, sizes = f"network.{network['name']}.", network["sizes"]
        for i, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            table[f"{prefix}{i}.weight"], table[f"{prefix}{i}.bias"] = (n_out, n_in), (n_out,)
        for side, size in (("input", sizes[0]), ("output", sizes[-1])):
            table[f"{prefix}{side}_center"] = table[f"{prefix}{side}_scale"] = (size,)
    return table


def _misfits(module: Any, weights: Mapping[str, Any]) -> list[str]:
    """What is missing, unknown or of a wrong shape among weights, in words."""
    required = _required_shapes(module)
    optional = {
        f"network.{n['name']}.input_{end}": (n["sizes"][0],) for n in module.networks for end in ("low", "high")
    }
    wrong = [f"`{name}` is missing" for name in required if name not in weights]
    for name, value in weights.items():
        shape = required.get(name, optional.get(name))
        if name == "initial":
            shape = (*value.shape[:1], len(module.states))
        elif name.startswith("per_trajectory.") and name.partition(".")[2] in module.per_trajectory:
            shape = value.shape[:1]
        elif name.startswith("recognition."):
            shape = value.shape
        if shape is None:
            wrong.append(f"`{name}` is not a weight of this model")
        elif value.shape != shape:
            wrong.append(f"`{name}` has the shape {list(value.shape)} instead of {list(shape)}")
        elif name in required and not np.all(np.isfinite(value)):
            wrong.append(f"`{name}` has entries that are not finite")
    return wrong


def _random_weights(module: Any, generator: Any) -> dict[str, Any]:
    """Random weights: uniform in +-1/sqrt(inputs), in the last layer a tenth of that, so that slopes are small."""
    weights: dict[str, Any] = {"constants": np.array(module.defaults["constants"], dtype=np.float64)}
    for network in module.networks:
        prefix, sizes = f"network.{network['name']}.", network["sizes"]
        for i, (n_in, n_out) in enumerate(itertools.pairwise(sizes)):
            bound = (0.1 if i == len(sizes) - 2 else 1.0) / n_in**0.5
            weights[f"{prefix}{i}.weight"] = generator.uniform(-bound, bound, (n_out, n_in))
            weights[f"{prefix}{i}.bias"] = generator.uniform(-bound, bound, n_out)
        ranges = [r if r is not None and np.all(np.isfinite(r)) else (-1.0, 1.0) for r in network["ranges"]]
        low, high = np.array(ranges, dtype=np.float64).reshape(-1, 2).T
        weights[prefix + "input_center"] = (low + high) / 2
        weights[prefix + "input_scale"] = np.where(high > low, (high - low) / 2, 1.0)
        weights[prefix + "output_center"] = np.array(network["neutral"], dtype=np.float64)
        weights[prefix + "output_scale"] = np.ones(sizes[-1])
    return weights


def _described(module: Any) -> str:
    """The values of the constants and the sizes of the networks, as in `B=5, beta=1, phi: 3-8-8-1`."""
    parts = [f"{name}={value:.6g}" for name, value in zip(module.constants, module.weights["constants"], strict=True)]
    if len(parts) > 8:
        parts = [*parts[:8], f"{len(parts) - 8} more constants"]
    parts += [f"{', '.join(n['outputs'])}: {'-'.join(map(str, n['sizes']))}" for n in module.networks]
    return ", ".join(parts)
