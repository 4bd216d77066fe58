"""Initial states of all trajectories, as functions of the trainable vector."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import FoundStarts, Networks, SearchStarts, steady_starts
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.problem import Packed, Parameters, Problem

KEPT = 8
"""Steady starts of this many vectors are kept: a plan, a solution and its derivatives need the same."""

_FOUND: OrderedDict[tuple[int, int, bytes], tuple[Packed, Parameters, FoundStarts]] = OrderedDict()


def initial_states(
    problem: Problem, parameters: Parameters, vector: Tensor, x0: Tensor, constants: Tensor, networks: Networks
) -> Tensor:
    """Initial states [N, n_states] at a vector: `x0` with the values that the model gives; NaN where there is no steady
    state. Differentiable in `x0`, `constants` and what the networks hold."""
    return initial_or_failure(problem, parameters, vector, x0, constants, networks)[0]


def initial_or_failure(
    problem: Problem, parameters: Parameters, vector: Tensor, x0: Tensor, constants: Tensor, networks: Networks
) -> tuple[Tensor, dict[int, tuple[str, str]]]:
    """The same, with the state and the reason of each trajectory that has no steady state."""
    rows = parameters.given
    if len(rows) == len(x0):
        return _as_given(problem, parameters, vector, x0, constants, networks)
    which = torch.from_numpy(rows).to(x0.device)
    start, failed = _as_given(problem, parameters, vector, x0[which], constants[which], networks)
    return x0.index_copy(0, which, start), {int(rows[row]): why for row, why in failed.items()}


def steady_rows(problem: Problem, parameters: Parameters, constants: Tensor) -> Tensor:
    """The trajectories that start in a steady state: networks are called for these alone."""
    rows, packed = parameters.given, problem.packed
    which = torch.from_numpy(rows).to(constants.device)
    if problem.model.steady is None:
        return which[:0]
    condition, inputs = constants.new_tensor(packed.condition[rows]), constants.new_tensor(first_inputs(packed)[rows])
    arithmetic, k = torch_arithmetic(problem.module), constants[which].unbind(1)
    chosen = torch.as_tensor(problem.module.equations.steady(arithmetic, condition, inputs, k)[3])
    return which[chosen.to(which.device).expand(len(rows)) > 0]


def _as_given(
    problem: Problem, parameters: Parameters, vector: Tensor, x0: Tensor, constants: Tensor, networks: Networks
) -> tuple[Tensor, dict[int, tuple[str, str]]]:
    """The initial states of the trajectories that start as the model says, `x0` and `constants` being theirs alone."""
    module, packed, rows = problem.module, problem.packed, parameters.given
    k = constants.unbind(1)
    condition = x0.new_tensor(packed.condition[rows])
    start: Tensor = module.equations.initial(torch_arithmetic(module), x0, condition, k)
    if problem.model.steady is None:
        return start, {}

    def search(run: SearchStarts) -> FoundStarts:
        key = id(packed), id(parameters), vector.detach().numpy(force=True).tobytes()
        if key not in _FOUND:
            with torch.no_grad():
                found = run(module.torch_networks(parameters.weights(vector.detach())))
            _FOUND[key] = packed, parameters, found  # with their owners, so that their ids stay theirs
            while len(_FOUND) > KEPT:
                _FOUND.popitem(last=False)
        return _FOUND[key][2]

    inputs = start.new_tensor(first_inputs(packed)[rows])
    return steady_starts(module, start, condition, inputs, k, networks, search)


def first_inputs(packed: Packed) -> Array:
    """The inputs [N, n_inputs] at the start of each trajectory."""
    count, width = packed.trajectories, packed.row_inputs.shape[1]
    out = np.zeros((count, width))
    first = np.flatnonzero(packed.row_index == 0)
    out[packed.row_trajectory[first]] = packed.row_inputs[first]
    if packed.depth:
        moving = packed.steps > 0
        out[moving] = packed.inputs[0, moving, 0]
    return out
