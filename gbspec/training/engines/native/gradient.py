"""Half the sum of squared residuals by the native kernel.

The kernel takes what the right-hand side uses (layers' weights, constants, initial states) and gives residuals and the
gradient of half their squares in one call; how these come from the trainable vector is left to torch, whose automatic
differentiation takes the kernel as one node (`HalfSquares`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gbspec.data.trajectories import Array
from gbspec.diagnostics import Defect
from gbspec.training.engines.native.inputs import KernelInputs
from gbspec.training.engines.native.kernel import Kernel, Swept
from gbspec.training.problem.packing import Integers
from gbspec.training.problem.parameters import Parameters

if TYPE_CHECKING:
    from gbspec.training.problem.problem import Problem


class HalfSquares(torch.autograd.Function):
    """Half the sum of squared residuals; its gradient is found in the same call of the kernel as its value."""

    @staticmethod
    def forward(
        ctx: Any,
        call: Callable[[], Swept],
        weights: Tensor,
        constants: Tensor,
        initial: Tensor,
        amounts: Tensor,
        times: Tensor,
    ) -> Tensor:
        """`call` sweeps at the values of the other arguments."""
        swept = call()
        known = constants.shape[1] - swept.d_constants.shape[1]
        d_constants = np.concatenate([np.zeros((len(constants), known)), swept.d_constants], 1)
        found = (swept.d_weights, d_constants, swept.d_initial, swept.d_amounts, swept.d_times)
        ctx.save_for_backward(*map(torch.from_numpy, found))
        return weights.new_tensor(0.5 * float(np.vdot(swept.residuals, swept.residuals)))

    @staticmethod
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor | None, ...]:
        """The gradient found with the value."""
        return (None, *(scale * saved for saved in ctx.saved_tensors))


def half_squares(
    kernel: Kernel, problem: Problem, parameters: Parameters, theta: Array, index: Integers | None = None
) -> tuple[float, Array]:
    """Half the sum of squared residuals of the trajectories `index` (None: all), its gradient in the whole vector."""
    vector = torch.from_numpy(theta).requires_grad_()
    n = KernelInputs.of(problem, parameters, vector)

    def call() -> Swept:
        return kernel.sweep(problem.tables(n.arrivals), n, True, index=index)

    loss: Tensor = HalfSquares.apply(call, n.weights, n.constants, n.initial, n.amounts, n.times)  # type: ignore[no-untyped-call]  # torch's
    if not loss.requires_grad:
        return float(loss), np.zeros_like(theta)
    (gradient,) = torch.autograd.grad(loss, vector, allow_unused=True)
    return float(loss.detach()), np.zeros_like(theta) if gradient is None else gradient.numpy()


def solved(problem: Problem, parameters: Parameters, theta: Tensor) -> tuple[Array, Array, Array]:
    """Residuals [R, C], states on arrival at key rows [R, n_states] and initial states [N, n_states] at `theta`."""
    if problem.kernel is None:
        raise Defect("a problem without a kernel was to be solved by it")
    with torch.no_grad():
        inputs = KernelInputs.of(problem, parameters, theta)
    swept = problem.kernel.sweep(problem.tables(inputs.arrivals), inputs, False)
    return swept.residuals, swept.states, inputs.initial.numpy()
