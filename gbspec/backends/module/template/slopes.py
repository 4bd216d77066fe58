"""Derivatives by trained weights. Generated modules omit everything above the line `# <body>`."""

from __future__ import annotations

from typing import Any

import numpy as np

from gbspec.backends.module.template.arithmetic import _torch_arithmetic

# <body>
# ---------------------------------------------------------------------- derivatives by weights


def _function_slopes(module: Any, name: str, arguments: Any) -> dict[str, Any]:
    """Derivatives of an unknown's values at points [P, n_arguments] with respect to its network's trained weights and
    the constants: arrays [P, ...] by name."""
    import torch

    index, output, method = module.equations.unknowns[name]
    prefix = f"network.{module.networks[index]['name']}."
    weights = {key: torch.as_tensor(np.asarray(value)) for key, value in module.weights.items()}
    trained = {k: v for k, v in weights.items() if k.startswith(prefix) and k.endswith((".weight", ".bias"))}

    def value(varied: Any, point: Any) -> Any:
        networks = module.torch_networks({**weights, **varied})
        return method(_torch_arithmetic(), varied["constants"].unbind(), networks, *point.unbind())[output]

    found = torch.func.vmap(torch.func.grad(value), in_dims=(None, 0))(
        {**trained, "constants": weights["constants"]}, torch.as_tensor(arguments, dtype=torch.float64)
    )
    return {key: each.numpy() for key, each in found.items()}


def _rhs_slopes(module: Any, x: Any, by: Any, t: float, condition: Any, inputs: Any, constants: Any) -> dict[str, Any]:
    """Derivatives of `by` [P, n_states] times dx/dt at states [P, n_states] with respect to the trained weights and the
    constants: arrays [P, ...] by name."""
    import torch

    weights = {key: torch.as_tensor(np.asarray(value)) for key, value in module.weights.items()}
    trained = {key: value for key, value in weights.items() if key.endswith((".weight", ".bias"))}
    time, given, held, known, states, directions = (
        torch.as_tensor(np.asarray(value, dtype=np.float64)) for value in (t, condition, inputs, constants, x, by)
    )

    def value(varied: Any, state: Any, direction: Any) -> Any:
        networks = module.torch_networks({**weights, **varied})
        own = varied["constants"].unbind()
        return (module.equations.rhs(_torch_arithmetic(), time, state, given, held, own, networks) * direction).sum()

    # [algebraic
    # A search for algebraic variables cannot be mapped over points.
    leaves = {key: each.clone().requires_grad_() for key, each in {**trained, "constants": known}.items()}
    rows = [
        torch.autograd.grad(value(leaves, *point), [*leaves.values()], allow_unused=True, materialize_grads=True)
        for point in zip(states, directions, strict=True)
    ]
    if rows:
        return {key: torch.stack(each).numpy() for key, each in zip(leaves, zip(*rows, strict=True), strict=True)}
    # algebraic]
    slopes = torch.func.vmap(torch.func.grad(value), in_dims=(None, 0, 0))
    found = slopes({**trained, "constants": known}, states, directions)
    return {key: each.numpy() for key, each in found.items()}
