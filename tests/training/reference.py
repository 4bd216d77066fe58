"""Solutions and derivatives by the torch engine, the reference, for problems whose engine a test does not choose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines import objective
from gbspec.training.engines.linearised import Jacobian, Linearised
from gbspec.training.engines.native.engine import NativeEngine
from gbspec.training.engines.native.inputs import KernelInputs
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.torch.engine import TorchEngine
from gbspec.training.engines.torch.segments import Schedule
from gbspec.training.engines.torch.unroll import graph_residuals
from gbspec.training.problem.arrivals import Integers
from gbspec.training.problem.parameters import Parameters
from gbspec.training.problem.problem import Problem


@dataclass(frozen=True)
class Solution:
    """What `unroll` gives, and the residuals [R, C]."""

    before: Tensor
    after: Tensor
    initial: Tensor
    mean: Tensor
    residuals: Tensor


def unroll(problem: Problem, parameters: Parameters, theta: Tensor, device: str = "cpu") -> Solution:
    """The solution at a vector, differentiable in it."""
    precision = "float32" if theta.dtype == torch.float32 else "float64"
    engine = TorchEngine(problem, parameters, device, precision)
    plain = torch.zeros(len(theta)) if theta.device.type == "meta" else theta.detach()
    out = engine.unroll(theta, engine.plan(np.array(plain.to(torch.float64).tolist())))
    return Solution(out.before, out.after, out.initial, out.mean, graph_residuals(problem, out.mean))


def measured_residuals(problem: Problem, residuals: Tensor) -> Tensor:
    """The residuals of measured values alone, as a vector, row by row."""
    return residuals[torch.from_numpy(problem.seen)]


def solve(problem: Problem, parameters: Parameters, theta: Array) -> Array:
    """The residuals of measured values."""
    return objective.residual_vector(TorchEngine(problem, parameters), theta)


def linearise(
    problem: Problem, parameters: Parameters, theta: Array, only_local: bool = False, device: str = "cpu"
) -> Linearised:
    """Residuals and their Jacobian."""
    return objective.linearise(TorchEngine(problem, parameters, device), theta, only_local)


def half_squares(
    kernel: Kernel, problem: Problem, parameters: Parameters, theta: Array, index: Integers | None = None
) -> tuple[float, Array]:
    """Half the sum of squared residuals and its gradient, by a kernel."""
    return objective.half_squares(NativeEngine(problem, parameters, kernel), theta, index)


def schedule_of(problem: Problem, parameters: Parameters, theta: Array) -> Schedule:
    """The sub-steps as the torch graph takes them."""
    engine = TorchEngine(problem, parameters)
    return engine.schedule(engine.plan(theta))


def whole_jacobian(found: Jacobian, parameters: Parameters) -> Tensor:
    """A Jacobian with a column for each entry of the vector [m, size]."""
    out = torch.zeros((len(found.owner), parameters.size), dtype=found.local.dtype)
    out[:, : parameters.n_shared] = found.shared
    block = parameters.n_local
    for i in range(len(found.owner)):
        begin = parameters.n_shared + int(found.owner[i]) * block
        out[i, begin : begin + block] = found.local[i]
    return out


def kernel_residuals(engine: NativeEngine, theta: Array) -> Array:
    """The residuals [R, C] that the kernel computes for its own gradients."""
    with torch.no_grad():
        inputs = KernelInputs.of(engine.problem, engine.parameters, torch.from_numpy(theta))
    return engine.kernel.sweep(engine.tables(engine.plan(theta)), inputs, False).residuals
