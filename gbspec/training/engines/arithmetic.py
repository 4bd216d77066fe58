"""What every engine computes with torch: the generated module's arithmetic, and the predictions at the key rows."""

from __future__ import annotations

from torch import Tensor

from gbspec.backends import Arithmetic, GeneratedModule, Networks
from gbspec.training.problem import Problem


def torch_arithmetic(module: GeneratedModule) -> Arithmetic:
    """The generated module's torch arithmetic."""
    return module.arithmetic("torch")


def observe_rows(problem: Problem, states: Tensor, constants: Tensor, networks: Networks) -> Tensor:
    """Predicted channels at the key rows [R, C], from states [R, n_states] and constants [R, n_constants]."""
    packed = problem.packed
    c = states.new_tensor(packed.condition[packed.row_trajectory])
    t, u = states.new_tensor(packed.row_time), states.new_tensor(packed.row_inputs)
    k = tuple(constants.unbind(1))
    predicted: Tensor = problem.module.equations.observe(torch_arithmetic(problem.module), t, states, c, u, k, networks)
    return predicted
