"""What every engine computes with torch: the generated module's arithmetic, and the predictions at the key rows."""

from __future__ import annotations

import torch
from torch import Tensor

from gbspec.backends import Arithmetic, GeneratedModule, Networks
from gbspec.training.problem import Problem


def torch_arithmetic(module: GeneratedModule) -> Arithmetic:
    """The generated module's torch arithmetic."""
    return module.arithmetic("torch")


def observe_rows(
    problem: Problem, states: Tensor, constants: Tensor, networks: Networks, late: Tensor | None = None
) -> Tensor:
    """Predicted channels at the key rows [R, C], from states [R, n_states] and constants [R, n_constants], and from the
    delayed values `late` [R, n_delays] in models that have any."""
    packed = problem.packed
    c = states.new_tensor(packed.condition[packed.row_trajectory])
    t, u = states.new_tensor(packed.row_time), states.new_tensor(packed.row_inputs)
    u = u if late is None else torch.cat([u, late], 1)
    k = tuple(constants.unbind(1))
    predicted: Tensor = problem.module.equations.observe(torch_arithmetic(problem.module), t, states, c, u, k, networks)
    return predicted
