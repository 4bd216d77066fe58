"""The torch engine: the unrolled graph, on any device and in either precision. The reference for other engines."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines.columns import Columns
from gbspec.training.engines.deliveries import Paths
from gbspec.training.engines.engine import Lack, Moments, Unable, UnableError, by_group, taken
from gbspec.training.engines.linearised import Jacobian
from gbspec.training.engines.torch.delays import jacobian as delayed_jacobian
from gbspec.training.engines.torch.jacobian import jacobian
from gbspec.training.engines.torch.planning import planned
from gbspec.training.engines.torch.segments import Schedule
from gbspec.training.engines.torch.unroll import Unrolled, graph_residuals, unroll
from gbspec.training.problem import Integers, Parameters, Path, Problem


class TorchEngine:
    """An engine on `device` in `precision`; gradients are computed for at most `batch` trajectories at a time (None:
    all), to bound the memory."""

    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        device: str = "cpu",
        precision: Literal["float64", "float32"] = "float64",
        batch: int | None = None,
    ) -> None:
        self.problem, self.parameters, self.device, self.batch = problem, parameters, device, batch
        self.precision = precision
        self._dtype = torch.float32 if precision == "float32" else torch.float64
        self._paths = Paths(problem, planned)
        self._schedule: tuple[Path, Schedule] | None = None

    def rebound(self, problem: Problem, parameters: Parameters) -> Self:
        """The same engine for another problem or layout."""
        return type(self)(problem, parameters, self.device, self.precision, self.batch)

    def plan(self, theta: Array) -> Path:
        """The sub-steps at a vector."""
        return self._paths.at(self.parameters, theta)

    def schedule(self, path: Path) -> Schedule:
        """A path's sub-steps as tensors; the most recent ones are kept."""
        if self._schedule is None or self._schedule[0] is not path:
            self._schedule = path, Schedule(self.problem, path, self._dtype, self.device)
        return self._schedule[1]

    def unroll(self, theta: Tensor, path: Path, whole: bool = False) -> Unrolled:
        """The solution at a vector, differentiable in it, on the device of `theta`; `whole` as for `unroll`."""
        home = theta.device
        out = unroll(self.problem, self.parameters, theta.to(self.device), self.schedule(path), whole)
        return Unrolled(out.before.to(home), out.after.to(home), out.initial.to(home), out.mean.to(home))

    def moments(self, theta: Array, path: Path) -> Moments:
        """The predictions at a vector."""
        with torch.no_grad():
            out = self.unroll(torch.from_numpy(theta).to(self._dtype), path)
        before, after, initial, mean = (
            np.asarray(part.numpy(), dtype=np.float64) for part in (out.before, out.after, out.initial, out.mean)
        )
        return Moments(mean, before, after, initial)

    def jacobian(self, theta: Array, path: Path, moments: Moments, scale: Array, only_local: bool = False) -> Jacobian:
        """The exact derivatives of the means, in double precision."""
        if self.problem.model.delays:
            vector, schedule = torch.from_numpy(theta), Schedule(self.problem, path, torch.float64, "cpu")

            def predicted(vector: Tensor) -> Tensor:
                return unroll(self.problem, self.parameters, vector, schedule).mean

            return delayed_jacobian(self.parameters, self.problem, predicted, vector, scale, only_local)
        columns = Columns(self.problem, self.parameters, theta, only_local, self.device)
        found = jacobian(columns, path, moments, columns.observed(moments.before, scale))
        return Jacobian(found.shared.cpu(), found.local.cpu(), found.owner.cpu())

    def pullback(self, theta: Array, path: Path, cotangent: Array, by: Integers | None = None) -> Array:
        """The product of a cotangent with the Jacobian of the means."""
        if by is not None:
            return by_group(self, theta, path, cotangent, by)
        vector = self._leaf(theta)
        mean = self.unroll(vector, path).mean
        return _gradient((mean * mean.new_tensor(cotangent)).sum(), vector)

    def half_squares(self, theta: Array, path: Path, index: Integers | None = None) -> tuple[float, Array]:
        """Half the sum of squared residuals and its gradient."""
        count = self.parameters.trajectories
        chosen = np.arange(count, dtype=np.int64) if index is None else index
        size = len(chosen) if self.batch is None or index is not None else self.batch
        if index is None and len(chosen) <= size:
            return self._half_squares(theta, path)
        total, whole = 0.0, np.zeros_like(theta)
        blocks = whole[self.parameters.n_shared :].reshape(count, self.parameters.n_local)
        for begin in range(0, len(chosen), max(size, 1)):
            some = chosen[begin : begin + size]
            part = taken(self, some)
            vector = self.parameters.take_vector(theta, some)
            value, gradient = part._half_squares(vector, part.plan(vector))
            total += value
            whole[: self.parameters.n_shared] += gradient[: self.parameters.n_shared]
            blocks[some] += gradient[self.parameters.n_shared :].reshape(len(some), self.parameters.n_local)
        return total, whole

    def _half_squares(self, theta: Array, path: Path) -> tuple[float, Array]:
        vector = self._leaf(theta)
        residuals = graph_residuals(self.problem, self.unroll(vector, path).mean)
        loss = 0.5 * (residuals**2).sum()
        return float(loss.detach()), _gradient(loss, vector)

    def second(self, theta: Array, path: Path, direction: Array, cotangent: Array) -> Array:
        """The gradient of `cotangent` times the means' Jacobian times `direction`, by differentiating twice."""
        if self.problem.model.events:
            raise UnableError(Unable(Lack.SECOND, "the times of events have first derivatives only"))
        vector = self._leaf(theta)
        mean = self.unroll(vector, path).mean
        (first,) = torch.autograd.grad((mean * mean.new_tensor(cotangent)).sum(), vector, create_graph=True)
        return _gradient((first * first.new_tensor(direction)).sum(), vector)

    def _leaf(self, theta: Array) -> Tensor:
        return torch.from_numpy(theta).to(self._dtype).requires_grad_()


def _gradient(value: Tensor, vector: Tensor) -> Array:
    """The gradient of a scalar as float64; zero where it does not depend on the vector."""
    if not value.requires_grad:
        return np.zeros(len(vector))
    (found,) = torch.autograd.grad(value, vector, allow_unused=True)
    return np.zeros(len(vector)) if found is None else np.asarray(found.numpy(), dtype=np.float64)
