"""Arguments as tensors. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

# <body>
# ---------------------------------------------------------------------- vectors


def _tensor(value: Any, like: Any = None) -> Any:
    """A tensor of the type and device of another; without another, its own or float64."""
    import torch

    if like is not None:
        return torch.as_tensor(value, dtype=like.dtype, device=like.device)
    tensor = value if isinstance(value, torch.Tensor) else torch.as_tensor(np.asarray(value, dtype=np.float64))
    return tensor if tensor.is_floating_point() else tensor.double()


def _vector(value: Any, size: int, what: str, like: Any = None) -> Any:
    """A tensor with `size` numbers on its last axis."""
    tensor = _tensor(value, like)
    if size and tensor.ndim == 0 and size == 1:
        tensor = tensor[None]
    if size and (tensor.ndim == 0 or tensor.shape[-1] != size):
        raise ValueError(f"{what} must have {size} numbers on the last axis, not the shape {list(tensor.shape)}")
    return tensor


def _by_name(module: Any, kind: str, values: Mapping[str, Any]) -> Any:
    """A vector [..., n] from the values [...] of its components by name; those with a default may be left out."""
    import torch

    names = getattr(module, kind)
    table = {**dict(zip(names, module.defaults.get(kind, (None,) * len(names)), strict=True)), **values}
    unknown, lacking = sorted(set(values) - set(names)), [name for name in names if table[name] is None]
    if unknown or lacking:
        wrong = [f"{', '.join(unknown)} is not among them"] * bool(unknown)
        wrong += [f"{', '.join(lacking)} is missing"] * bool(lacking)
        raise ValueError(f"the {kind} are {', '.join(names) or 'none'}: {'; '.join(wrong)}")
    parts = [_tensor(table[name]) for name in names]
    shape = np.broadcast_shapes(*(part.shape for part in parts))
    return torch.stack([part.expand(shape) for part in parts], -1) if parts else torch.zeros(0, dtype=torch.float64)


def _signal(module: Any, inputs: Any, grid: list[float], x: Any) -> Callable[[int, float], Any]:
    """Inputs as a function of the index of an interval and a time in it."""
    if callable(inputs):
        return lambda i, t: _vector(inputs(t), len(module.inputs), "inputs", x)
    table = module.defaulted(inputs, "inputs", x)
    if inputs is None or not module.inputs:
        return lambda i, t: table
    if table.ndim < 2 or table.shape[-2] != len(grid):
        raise ValueError(f"inputs must have the shape [..., {len(grid)}, {len(module.inputs)}]: one row per time")
    linear = _tensor([float(kind == "linear") for kind in module.interpolation], x)

    def value(i: int, t: float) -> Any:
        if len(grid) == 1:
            return table[..., 0, :]
        share = linear * ((t - grid[i]) / (grid[i + 1] - grid[i]))
        return table[..., i, :] + share * (table[..., i + 1, :] - table[..., i, :])

    return value


def _spread(x: Any, condition: Any, inputs: Any, constants: Any) -> Any:
    """States [..., n_states] for the batch of all of these."""
    shapes = [vector.shape[:-1] for vector in (x, condition, inputs)]
    batch = np.broadcast_shapes(*shapes, *(value.shape for value in constants))
    return x.expand(*batch, x.shape[-1])
