"""The Jacobian by the native kernel in models with delays: forward sensitivities of whole trajectories.

Derivatives of intervals between key rows, which the kernel chains in other models, do not suffice: a later interval
looks at the solution in all those before, as far back as the longest delay.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.columns import Columns
from gbspec.training.engines.linearised import Jacobian
from gbspec.training.engines.native.inputs import KernelInputs
from gbspec.training.engines.native.jacobian import Doses, trained
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.native.tables import Tables
from gbspec.training.engines.native.threads import workspace
from gbspec.training.problem import Packed, Parameters, Problem


def delayed_jacobian(columns: Columns, kernel: Kernel, inputs: KernelInputs, tables: Tables, scale: Array) -> Jacobian:
    """Derivatives of the measured values, each times its `scale` [R, C]."""
    problem, parameters, packed = columns.problem, columns.parameters, columns.problem.packed
    n, learnables = len(problem.model.states), len(problem.model.learnables)
    row, _ = np.nonzero(problem.seen)
    found = _sensitivities(columns, kernel, inputs, tables, scale)
    owner = torch.from_numpy(packed.row_trajectory[row])
    whole = torch.from_numpy(found)
    of_constants, of_weights = whole[:, :learnables], whole[:, learnables + n :]
    of_starts = whole[:, learnables : learnables + n]
    shared = torch.zeros((len(row), columns.shared), dtype=torch.float64)
    shared[:, : of_weights.shape[1]] = of_weights
    local = torch.zeros((len(row), parameters.n_local), dtype=torch.float64)
    unused = [columns.zeros(())] * len(problem.model.constants)
    each = [column[:, None] for column in of_constants.unbind(1)]
    columns.add_constants(shared[:, None], local[:, None], [*unused, *each], owner)
    begun, own_begun = columns.initial(torch.arange(packed.trajectories))
    for i in range(packed.trajectories):
        mine = owner == i
        shared[mine] += of_starts[mine] @ begun[i]
        local[mine] += of_starts[mine] @ own_begun[i]
    return Jacobian(shared, local, owner)


def _sensitivities(columns: Columns, kernel: Kernel, inputs: KernelInputs, tables: Tables, scale: Array) -> Array:
    """Derivatives [m, columns] of the measured values by learnable constants in natural units, initial states and
    trained weights."""
    problem, parameters, library = columns.problem, columns.parameters, kernel.library
    row, channel = np.nonzero(problem.seen)
    place = np.full(problem.seen.shape, -1, dtype=np.int32)
    place[row, channel] = np.arange(len(row))
    weights = len(inputs.weights) if columns.shared else 0
    unused = np.zeros(len(inputs.weights))
    doses = Doses(problem, parameters, torch.from_numpy(columns.theta), tables)
    with torch.no_grad():
        factor, shift = trained(problem, parameters, columns.theta) if columns.shared else (unused, unused)
    count = len(problem.model.learnables) + len(problem.model.states) + weights
    found, window = np.zeros((len(row), count)), _window(tables.packed, inputs.lags.numpy())
    given = library.struct(
        "Sensitivities",
        count=len(tables.order),
        columns=count,
        window=window,
        order=tables.order,
        factor=factor,
        shift=shift,
        of_amounts=np.ascontiguousarray(doses.of_amount),
        of_times=np.ascontiguousarray(doses.of_time),
        of_lags=_of_lags(problem, parameters, torch.from_numpy(columns.theta)),
        place=place,
        scale=np.ascontiguousarray(scale),
        out=found,
    )
    space = workspace(library.sensitivity_bytes(tables.depth, count, window))
    library.sensitivities(tables.data(library), inputs.struct(library), given, space)
    return found


def _window(packed: Packed, lags: Array) -> int:
    """The most sub-steps that lie between one and that which its longest delay looks at, and a few more."""
    most = 0
    for i, count in enumerate(packed.steps):
        begins = packed.t[:count, i]
        looked_at = np.searchsorted(begins, begins - lags[i].max(), side="right") - 1
        most = max(most, int((np.arange(count) - np.maximum(looked_at, 0)).max(initial=0)))
    return most + 3


def _of_lags(problem: Problem, parameters: Parameters, vector: Tensor) -> Array:
    """Derivatives [N, n_lags, n_learnables] of the times of delays by the learnable constants."""
    known, packed = len(problem.model.constants), problem.packed
    k = [column.detach().clone() for column in parameters.constants(vector).unbind(1)]
    for column in k[known:]:
        column.requires_grad_()
    condition = torch.from_numpy(packed.condition).unbind(1)
    lags = problem.module.equations.lags(torch_arithmetic(problem.module), condition, k)
    found = np.zeros((packed.trajectories, len(lags), len(problem.model.learnables)))
    for i, lag in enumerate(lags):
        if isinstance(lag, Tensor) and lag.requires_grad:
            slopes = torch.autograd.grad(lag.sum(), k[known:], allow_unused=True)
            for j, slope in enumerate(slopes):
                found[:, i, j] = 0.0 if slope is None else slope.numpy()
    return found
