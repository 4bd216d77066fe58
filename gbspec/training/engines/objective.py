"""The loss of a packed problem and its gradient, by the native kernel or by the torch graph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from gbspec.backends.native import Precision
from gbspec.data.trajectories import Array
from gbspec.training.engines.native.gradient import half_squares as by_kernel
from gbspec.training.engines.native.kernel import kernel_of
from gbspec.training.engines.torch.unroll import measured_residuals, unroll
from gbspec.training.problem.packing import Integers
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem


def objective(
    problem: Problem,
    parameters: Parameters,
    backend: Literal["native", "torch"] = "native",
    precision: Precision = "float64",
    batch: int | None = None,
) -> Callable[[Array], tuple[float, Array]]:
    """The training loss of a packed problem and its gradient as a function of the trainable vector [size].

    The loss is the mean of half squared residuals over all measured values; vector and gradient are float64 arrays.
    `backend="native"` compiles the kernel on the first call for a model (seconds, kept in the user's cache) and runs it
    on `torch.get_num_threads()` threads. `backend="torch"` unrolls the torch graph, at most `batch` trajectories at a
    time. Both work in the precision that is asked for. Raises ValueError where the native kernel cannot be had.

        f = objective(problem, parameters, "native")
        loss, gradient = f(theta)
    """
    if backend == "native":
        kernel = kernel_of(problem.model, type(problem.module), precision)
        if isinstance(kernel, str):
            raise ValueError(kernel)
        problem = replace(problem, kernel=kernel)
    else:
        problem = replace(problem, kernel=None)
    size = batch if batch is not None else max(parameters.trajectories, 1)
    dtype = torch.float32 if precision == "float32" else torch.float64
    return lambda theta: loss_and_gradient(problem, parameters, theta, size, dtype)


def loss_and_gradient(
    problem: Problem, parameters: Parameters, theta: Array, batch: int, dtype: torch.dtype = torch.float64
) -> tuple[float, Array]:
    """Mean of half squared residuals and its gradient; the torch graph takes `batch` trajectories at a time, to bound
    the memory."""
    count = max(int((problem.packed.weights > 0).sum()), 1)
    if problem.kernel is not None:
        value, gradient = by_kernel(problem.kernel, problem, parameters, theta)
        return value / count, gradient / count
    total, whole = 0.0, np.zeros_like(theta)
    for begin in range(0, parameters.trajectories, batch):
        index = np.arange(begin, min(begin + batch, parameters.trajectories), dtype=np.int64)
        value, part = _by_graph(problem.take(index), parameters, theta, index, dtype)
        total += value
        whole += part
    return total / count, whole / count


def half_squares(problem: Problem, parameters: Parameters, theta: Array, index: Integers) -> tuple[float, Array]:
    """Sum of half squared residuals of the trajectories `index`, and its gradient in the whole vector."""
    if problem.kernel is not None:
        return by_kernel(problem.kernel, problem, parameters, theta, index)
    return _by_graph(problem.take(index), parameters, theta, index)


def _by_graph(
    problem: Problem, parameters: Parameters, theta: Array, index: Integers, dtype: torch.dtype = torch.float64
) -> tuple[float, Array]:
    """The same for a problem of these trajectories alone, through the torch graph."""
    local = parameters.take(index)
    vector = torch.from_numpy(parameters.take_vector(theta, index)).to(dtype).requires_grad_()
    residuals = measured_residuals(problem, unroll(problem, local, vector).residuals)
    loss = 0.5 * (residuals**2).sum()
    gradient = np.zeros_like(theta)
    if loss.requires_grad:
        (found,) = torch.autograd.grad(loss, vector)
        part = found.numpy()
        gradient[: parameters.n_shared] = part[: parameters.n_shared]
        blocks = gradient[parameters.n_shared :].reshape(parameters.trajectories, parameters.n_local)
        blocks[index] = part[parameters.n_shared :].reshape(len(index), parameters.n_local)
    return float(loss.detach()), gradient
