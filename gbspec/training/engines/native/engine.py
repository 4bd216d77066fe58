"""The native engine: solutions, gradients and Jacobians by the generated and compiled kernel, on the processor."""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines.arithmetic import observe_rows
from gbspec.training.engines.columns import Columns
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.engine import Lack, Moments, Unable, UnableError, by_group
from gbspec.training.engines.linearised import Jacobian
from gbspec.training.engines.native.control import Planner
from gbspec.training.engines.native.delays import delayed_jacobian
from gbspec.training.engines.native.gradient import HalfSquares
from gbspec.training.engines.native.inputs import KernelInputs, Latest
from gbspec.training.engines.native.jacobian import jacobian
from gbspec.training.engines.native.kernel import Kernel, Swept
from gbspec.training.engines.native.tables import Tables
from gbspec.training.engines.torch import planned
from gbspec.training.problem import Integers, Parameters, Path, Problem, residual_slopes


class NativeEngine:
    """An engine with one compiled kernel; Jacobians need a kernel in double precision."""

    def __init__(self, problem: Problem, parameters: Parameters, kernel: Kernel) -> None:
        self.problem, self.parameters, self.kernel = problem, parameters, kernel
        self._latest = Latest()
        self._paths = Paths(problem, Planner(kernel, self._latest) if kernel.plans else planned)
        self._tables: Tables | None = None

    def rebound(self, problem: Problem, parameters: Parameters) -> Self:
        """The same engine for another problem or layout."""
        return type(self)(problem, parameters, self.kernel)

    def plan(self, theta: Array) -> Path:
        """The sub-steps at a vector."""
        return self._paths.at(self.parameters, theta)

    def tables(self, path: Path) -> Tables:
        """The data on a path in the kernel's format; the most recent ones are kept."""
        if self._tables is None or self._tables.path is not path:
            self._tables = Tables(self.problem, path)
        return self._tables

    def moments(self, theta: Array, path: Path) -> Moments:
        """The predictions at a vector."""
        vector = torch.from_numpy(theta)
        with torch.no_grad():
            inputs = self._latest.at(self.problem, self.parameters, theta)
            swept = self.kernel.sweep(self.tables(path), inputs, False)
            before, mean = swept.states, self._observed(vector, swept, inputs.constants)
        return Moments(mean, before, self.problem.forcing.reset(before), inputs.initial.numpy())

    def happened(self, theta: Array, path: Path) -> Swept:
        """Solutions with how often each event happens in each trajectory [N, events], and whether these have no end."""
        return self.kernel.sweep(self.tables(path), self._latest.at(self.problem, self.parameters, theta), False)

    def _observed(self, vector: Tensor, swept: Swept, constants: Tensor) -> Array:
        """The channels at the key rows [R, C], from the states and delayed values there."""
        channels = self.problem.model.channels
        states = [channel.state for channel in channels if channel.state is not None]
        if len(states) == len(channels):
            return swept.states[:, states]
        networks = self.problem.module.torch_networks(self.parameters.weights(vector))
        owner = torch.from_numpy(self.problem.packed.row_trajectory)
        late = torch.from_numpy(swept.late) if self.problem.model.delays else None
        found = observe_rows(self.problem, torch.from_numpy(swept.states), constants[owner], networks, late)
        return np.asarray(found.numpy(), dtype=np.float64)

    def jacobian(self, theta: Array, path: Path, moments: Moments, scale: Array, only_local: bool = False) -> Jacobian:
        """The exact derivatives of the means."""
        columns = Columns(self.problem, self.parameters, theta, only_local)
        inputs = self._latest.at(self.problem, self.parameters, theta)
        if self.problem.model.delays:
            return delayed_jacobian(columns, self.kernel, inputs, self.tables(path), scale)
        observed = columns.observed(moments.before, scale)
        return jacobian(columns, self.kernel, inputs, self.tables(path), moments, observed)

    def pullback(self, theta: Array, path: Path, cotangent: Array, by: Integers | None = None) -> Array:
        """The product of a cotangent with the Jacobian of the means."""
        if by is not None:
            return by_group(self, theta, path, cotangent, by)
        # The kernel expects cotangents of residuals.
        slopes = residual_slopes(self.problem, self.moments(theta, path).mean)
        seen = slopes != 0
        of_residuals = np.where(seen, cotangent / np.where(seen, slopes, 1.0), 0.0)
        return self._swept(theta, path, None, of_residuals)[1]

    def half_squares(self, theta: Array, path: Path, index: Integers | None = None) -> tuple[float, Array]:
        """Half the sum of squared residuals and its gradient."""
        return self._swept(theta, path, index, None)

    def _swept(self, theta: Array, path: Path, index: Integers | None, cotangent: Array | None) -> tuple[float, Array]:
        """One call of the kernel, forward and backward: half the sum of squared residuals, and the product of
        `cotangent` (None: the residuals) with the residuals' Jacobian."""
        vector = torch.from_numpy(theta).requires_grad_()
        n = KernelInputs.of(self.problem, self.parameters, vector)

        def call() -> Swept:
            return self.kernel.sweep(self.tables(path), n, True, cotangent=cotangent, index=index)

        loss: Tensor = HalfSquares.apply(call, n.weights, n.constants, n.initial, n.amounts, n.times, n.lags)  # type: ignore[no-untyped-call]  # torch's
        if not loss.requires_grad:
            return float(loss), np.zeros_like(theta)
        (gradient,) = torch.autograd.grad(loss, vector, allow_unused=True)
        return float(loss.detach()), np.zeros_like(theta) if gradient is None else gradient.numpy()

    def second(self, theta: Array, path: Path, direction: Array, cotangent: Array) -> Array:
        """Raises UnableError: the kernel has only first derivatives."""
        raise UnableError(Unable(Lack.SECOND, "the native kernel has no second derivatives; the torch engine has them"))
