"""Predictions and sensitivities of models with networks: a sweep forward over the sub-steps, and back for derivatives.

The steps, with sensitivities, and their cotangents are functions of casadi (`gbspec.backends.swept`), evaluated for all
trajectories at once. Derivatives are exact: those of the steps taken.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.backends import Swept, network_layers, swept
from gbspec.ir import METHODS, Explicit
from gbspec.training.engines import torch_arithmetic
from gbspec.training.problem import Parameters, Path, Problem, path_of


def covered(problem: Problem) -> bool:
    """Whether the sweeps cover a problem: the lags of its doses are known, and its steps are fixed and explicit."""
    fixed = problem.control is None and isinstance(METHODS[problem.module.solver], Explicit)
    return fixed and all(problem.packed.doses.known)


class Sweeps:
    """The sweeps of one problem."""

    def __init__(self, problem: Problem, parameters: Parameters, distributed: tuple[str, ...]) -> None:
        self.problem, self.parameters = problem, parameters
        packed = problem.packed
        names = list(problem.module.constants)
        instance = type(problem.module)(_weights(problem, self.parameters), {})
        self.functions: Swept = swept(instance, [names.index(name) for name in distributed])
        self.known = np.array([c.value for c in problem.model.constants])
        self.times = 1 + len(distributed)
        count = packed.trajectories
        self.maps = {
            name: getattr(self.functions, name).map(count)
            for name in ("start", "start_back", "step", "step_back", "step_back_constants")
        }
        self.rows = packed.rows
        self.observe = self.functions.observe.map(packed.rows)
        self.observe_back = self.functions.observe_back.map(packed.rows)
        self.observe_back_constants = self.functions.observe_back_constants.map(packed.rows)
        # Derivatives by the constants alone are asked for most often, and cost a fraction of those by all weights.
        self.of_layers = True
        self.start = parameters.start_value.T
        self.condition = packed.condition.T
        path: Path = path_of(packed, packed.doses.time + np.zeros_like(packed.doses.time))
        self.amounts = _amounts(problem, path)
        row, self.channel = np.nonzero(problem.seen)
        channels = len(problem.model.channels)
        self.place = np.stack([self.channel + i * channels for i in range(self.times)], 1)
        self.measured_row = row

    def layers(self, weights: Tensor) -> Tensor:
        """The folded layers of all networks as one vector, differentiable in the weights."""
        module, parameters = self.problem.module, self.parameters
        tables = parameters.weights(torch.cat([weights, weights.new_zeros(parameters.size - len(weights))]))
        found = network_layers(module, tables, torch_arithmetic(module))
        return torch.cat([part.reshape(-1) for network in found for layer in network.folded for part in layer])

    def __call__(self, constants: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions [m] and sensitivities [m, q]."""
        found: tuple[Tensor, Tensor] = _Sweep.apply(constants, self.layers(weights), self)  # type: ignore[no-untyped-call]  # torch
        return found

    # ---------------------------------------------------------------- forward
    def forward(self, constants: Array, layers: Array) -> tuple[Array, list[Array], Array]:
        """Channels with their derivatives [R, ...], the states before each sub-step, and those at the rows."""
        packed, k = self.problem.packed, self._constants(constants)
        state = np.array(self.maps["start"](self.start, self.condition, k))
        states, at = [state], np.zeros((state.shape[0], self.rows))
        for s in range(packed.depth + 1):
            here = np.flatnonzero(packed.row_step == s)
            at[:, here] = state[:, packed.row_trajectory[here]]
            if s < packed.depth:
                state = np.array(self.maps["step"](state, *self._step(s), self.condition, k, layers))
                states.append(state)
        out = np.array(self.observe(at, *self._rows(k), layers))
        return out.T, states, at

    def _constants(self, constants: Array) -> Array:
        known = np.repeat(self.known[:, None], len(constants), axis=1)
        return np.concatenate([known, constants.T])

    def _step(self, s: int) -> list[Array]:
        packed = self.problem.packed
        nodes = [packed.inputs[s, :, node].T for node in range(len(packed.nodes))]
        return [packed.t[s][None], packed.h[s][None], *nodes, self.amounts[s]]

    def _rows(self, k: Array) -> list[Array]:
        packed = self.problem.packed
        owner = packed.row_trajectory
        return [packed.row_time[None], packed.row_inputs.T, self.condition[:, owner], k[:, owner]]

    # ---------------------------------------------------------------- back
    def back(
        self, constants: Array, layers: Array, states: list[Array], at: Array, cotangent: Array
    ) -> tuple[Array, Array]:
        """Cotangents of constants [N, K] and layers (zero, if they are not asked for) from those of channels and their
        derivatives [R, ...]."""
        packed, k = self.problem.packed, self._constants(constants)
        total = np.zeros(len(layers))

        def found(which: str, *given: Array) -> tuple[Array, Array]:
            """The cotangents of states and constants; those of the layers are added up."""
            maps = {**self.maps, "observe_back": self.observe_back}
            maps["observe_back_constants"] = self.observe_back_constants
            parts = maps[which if self.of_layers else f"{which}_constants"](*given)
            if self.of_layers:
                total[:] += _summed(np.array(parts[2]), len(layers))
            return np.array(parts[0]), np.array(parts[1])

        of_rows, of_k = found("observe_back", at, *self._rows(k), layers, cotangent.T)
        total_k = np.zeros_like(k)
        np.add.at(total_k.T, packed.row_trajectory, of_k.T)
        state = np.zeros_like(states[0])
        for s in range(packed.depth, -1, -1):
            if s < packed.depth:
                state, by_k = found("step_back", states[s], *self._step(s), self.condition, k, layers, state)
                total_k += by_k
            here = np.flatnonzero(packed.row_step == s)
            np.add.at(state.T, packed.row_trajectory[here], of_rows[:, here].T)
        total_k += np.array(self.maps["start_back"](self.start, self.condition, k, state))
        return total_k.T[:, len(self.known) :], total


def _summed(table: Array, size: int) -> Array:
    return np.asarray(table.reshape(size, -1).sum(axis=1), dtype=np.float64)


def _weights(problem: Problem, parameters: Parameters) -> dict[str, Array]:
    """The instance's arrays with the scales of the fit."""
    return {**problem.module.weights, **parameters.fixed}


def _amounts(problem: Problem, path: Path) -> Array:
    """What arrives before each sub-step [T, kinds, N], by kind of dose."""
    packed, kinds = problem.packed, len(problem.model.doses)
    out = np.zeros((packed.depth, kinds, packed.trajectories))
    doses = packed.doses
    here = np.flatnonzero(path.step >= 0)
    np.add.at(out, (path.step[here], doses.kind[here], doses.owner[here]), doses.amount[here])
    return out


@contextmanager
def by_constants(second: object) -> Iterator[None]:
    """Derivatives of the predictions are by the constants alone: those by the weights are wrong."""
    if not isinstance(second, Sweeps):
        yield
        return
    second.of_layers = False
    try:
        yield
    finally:
        second.of_layers = True


class _Sweep(torch.autograd.Function):
    """The sweeps as one function of torch, differentiable once."""

    @staticmethod
    def forward(ctx: Any, constants: Tensor, layers: Tensor, sweeps: Sweeps) -> tuple[Tensor, Tensor]:
        """Predictions and sensitivities of measured values."""
        arrays = constants.detach().numpy(), layers.detach().numpy()
        out, states, at = sweeps.forward(*arrays)
        ctx.sweeps, ctx.arrays, ctx.states, ctx.at, ctx.shape = sweeps, arrays, states, at, out.shape
        found = torch.from_numpy(out[sweeps.measured_row[:, None], sweeps.place])
        return found[:, 0].clone(), found[:, 1:].clone()

    @staticmethod
    def backward(ctx: Any, of_mean: Tensor, of_sensitivity: Tensor) -> tuple[Tensor, Tensor, None]:
        """The products with the Jacobian."""
        sweeps, cotangent = ctx.sweeps, np.zeros(ctx.shape)
        both = torch.cat([of_mean[:, None], of_sensitivity], 1).numpy()
        cotangent[sweeps.measured_row[:, None], sweeps.place] = both
        by_constants, by_layers = sweeps.back(*ctx.arrays, ctx.states, ctx.at, cotangent)
        return torch.from_numpy(np.ascontiguousarray(by_constants)), torch.from_numpy(by_layers), None
