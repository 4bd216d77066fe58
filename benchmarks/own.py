"""gbspec's own training step, by the functions that `gbspec train` calls."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch

from benchmarks.workload import Array, Workload
from gbspec.training.engines.native import threads as kernel_threads
from gbspec.training.engines.native.gradient import half_squares
from gbspec.training.engines.native.kernel import kernel_of
from gbspec.training.engines.torch.unroll import measured_residuals, unroll

Step = Callable[[], tuple[float, Array]]


def graph(work: Workload, dtype: torch.dtype) -> Step:
    """The generated module unrolled as a torch graph."""
    vector = torch.from_numpy(work.theta).to(dtype)

    def run() -> tuple[float, Array]:
        theta = vector.requires_grad_()
        residuals = measured_residuals(work.problem, unroll(work.problem, work.parameters, theta).residuals)
        loss = 0.5 * (residuals**2).mean()
        return float(loss.detach()), torch.autograd.grad(loss, theta)[0].numpy()

    return run


def native(work: Workload, dtype: torch.dtype, threads: int = 1) -> Step:
    """The generated native kernel; raises ImportError where it cannot be had."""
    precision = "float64" if dtype == torch.float64 else "float32"
    kernel = kernel_of(work.problem.model, type(work.problem.module), precision)
    if isinstance(kernel, str):
        raise ImportError(kernel)

    def run() -> tuple[float, Array]:
        torch.set_num_threads(threads)
        try:
            loss, gradient = half_squares(kernel, work.problem, work.parameters, work.theta)
        finally:
            torch.set_num_threads(1)
        return loss / work.measured, gradient / work.measured

    return run


def release() -> None:
    """Gives back the work space that a step keeps for the next one, which then takes all that it needs itself."""
    kernel_threads.release()


native_2 = partial(native, threads=2)
