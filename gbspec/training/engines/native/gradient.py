"""Half the sum of squared residuals by the native kernel.

The kernel takes the quantities that the right-hand side uses (layers' weights, constants, initial states) and returns
residuals and the gradient of half their squared sum in one call. The dependence of these quantities on the trainable
vector is left to torch, whose automatic differentiation treats the kernel as one node (`HalfSquares`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from gbspec.training.engines.native.kernel import Swept

Context: TypeAlias = Any
"""The context that torch passes to both methods; its class does not declare `saved_tensors`."""


class HalfSquares(torch.autograd.Function):
    """Half the sum of squared residuals; the kernel computes its gradient in the same call as its value."""

    @staticmethod
    def forward(
        ctx: Context,
        call: Callable[[], Swept],
        weights: Tensor,
        constants: Tensor,
        initial: Tensor,
        amounts: Tensor,
        times: Tensor,
        lags: Tensor,
    ) -> Tensor:
        """The value; `call` runs the kernel at the values of the other arguments."""
        swept = call()
        known = constants.shape[1] - swept.d_constants.shape[1]
        d_constants = np.concatenate([np.zeros((len(constants), known)), swept.d_constants], 1)
        found = (swept.d_weights, d_constants, swept.d_initial, swept.d_amounts, swept.d_times, swept.d_lags)
        ctx.save_for_backward(*map(torch.from_numpy, found))
        return weights.new_tensor(0.5 * float(np.vdot(swept.residuals, swept.residuals)))

    @staticmethod
    def backward(ctx: Context, scale: Tensor) -> tuple[Tensor | None, ...]:
        """The gradient that was computed with the value."""
        return (None, *(scale * saved for saved in ctx.saved_tensors))
