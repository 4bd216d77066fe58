"""What every engine computes with torch: the generated module's arithmetic, times of delays, predictions at the key
rows."""

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


def lags(problem: Problem, constants: Tensor) -> Tensor:
    """The times of the delays of each trajectory [N, n_lags] at the constants [N, n_constants]."""
    if not problem.model.delays:
        return constants.new_zeros((len(constants), 0))
    condition = constants.new_tensor(problem.packed.condition)
    found = problem.module.equations.lags(torch_arithmetic(problem.module), condition.unbind(1), constants.unbind(1))
    return torch.stack([lag + constants.new_zeros(len(constants)) for lag in found], 1)
