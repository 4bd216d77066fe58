"""The parts of a Jacobian that do not depend on the engine: columns, initial states, observations.

Every engine with exact derivatives propagates the sensitivity S of the state from interval to interval (an interval
lies between consecutive key rows of a trajectory). With A = d end / d start and J = d end / d parameters of an
interval, S becomes `A S + J` at its end; resets by forcing scale the rows of S by `1 - weight`. A and J are computed by
the engine; this module computes S at the initial state, the derivatives of observed quantities, and the columns to
which derivatives with respect to constants and weights belong.
"""

from __future__ import annotations

from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Model, symbol
from gbspec.training.engines.arithmetic import observe_rows
from gbspec.training.engines.linearised import Observed
from gbspec.training.engines.starting import initial_states, steady_rows
from gbspec.training.problem import STRETCH, Parameters, Problem

Taped = list[tuple[int, int, Tensor, Tensor]]
"""Calls of layers: network, layer, the layer's inputs, its pre-activations."""


class Columns:
    """The columns of one Jacobian at `theta`; with `only_local` there are no shared columns."""

    def __init__(
        self, problem: Problem, parameters: Parameters, theta: Array, only_local: bool, device: str = "cpu"
    ) -> None:
        self.problem, self.parameters, self.only_local = problem, parameters, only_local
        self.device, self.theta, self.vector = device, theta, torch.from_numpy(theta).to(device)
        with torch.no_grad():
            self.constants = parameters.constants(self.vector)
        self.n_states = len(problem.model.states)
        self.shared = 0 if only_local else parameters.n_shared

    @cached_property
    def offsets(self) -> dict[tuple[int, int], tuple[int, int, int]]:
        """Where the columns of each layer begin."""
        return _layer_offsets(self.parameters)

    @cached_property
    def weights(self) -> dict[str, Tensor]:
        """The networks' arrays."""
        found = {name: value.detach().clone() for name, value in self.parameters.weights(self.vector).items()}
        for name in self.parameters.weight_shapes:
            # This only makes every pre-activation part of the graph; gradients of the weights are never computed.
            found[name].requires_grad_()
        return found

    def tensor(self, table: NDArray[np.generic]) -> Tensor:
        """A table on the device."""
        return torch.from_numpy(table).to(self.device)

    def zeros(self, shape: tuple[int, ...]) -> Tensor:
        """Zeros of the vector's type on the device."""
        return torch.zeros(shape, dtype=self.vector.dtype, device=self.device)

    def of_trained_weights(self, shared: Tensor) -> Tensor:
        """Columns of the trained weights from those of the effective weights (they differ if contracts require
        signs)."""
        weights = self.parameters.weights(torch.from_numpy(self.theta))
        arrays = {name: value.numpy() for name, value in weights.items()}
        slopes = {} if self.only_local else self.problem.module.weight_slopes(arrays)
        position = 0
        for name, shape in self.parameters.weight_shapes.items():
            size = int(np.prod(shape))
            if name in slopes:
                shared[..., position : position + size] *= self.tensor(slopes[name].ravel())
            position += size
        return shared

    def initial(self, who: Tensor) -> tuple[Tensor, Tensor]:
        """Sensitivity of the initial states of some trajectories [B, n_states, columns]: shared and local."""
        parameters, n, count = self.parameters, self.n_states, len(who)
        d_start, *d_constants = (part[who] for part in self._start_derivatives)
        shared = self.zeros((count, n, self.shared))
        local = self.zeros((count, n, parameters.n_local))
        scale = self.tensor(parameters.start_free * parameters.start_scale * STRETCH)[who]
        local[:, :, len(parameters.own) :] = d_start * scale[:, None, :]
        self.add_constants(shared, local, d_constants, who)
        if self._start_weights is not None and not self.only_local:
            shared += self._start_weights[who]
        return shared, local

    @cached_property
    def _start_derivatives(self) -> list[Tensor]:
        """Derivatives of the initial states with respect to their learned values [N, n, n] and each constant [N, n]."""
        return self._starts[0]

    @cached_property
    def _start_weights(self) -> Tensor | None:
        """Derivatives of steady starts with respect to the weights [N, n, columns]; None where they do not matter."""
        return self._starts[1]

    @cached_property
    def _starts(self) -> tuple[list[Tensor], Tensor | None]:
        problem = self.problem
        if all(starts_of_data(problem.model)):
            shape = len(self.parameters.start_value), self.n_states
            known = np.array([state.initial.known for state in problem.model.states], dtype=bool)
            free = np.ones(shape)
            free[np.ix_(self.parameters.given, known)] = 0.0
            by_start = self.tensor(free).to(self.vector.dtype).diag_embed()
            return [by_start, *(self.zeros(shape) for _ in range(self.constants.shape[1]))], None
        tape: Taped = []
        x0 = self.parameters.starts(self.vector).detach().requires_grad_()
        k = [column.detach().clone().requires_grad_() for column in self.constants.unbind(1)]
        steady = problem.model.steady is not None
        networks = problem.module.torch_networks(self.weights, tape) if steady else ()
        constants = torch.stack(k, 1) if k else self.zeros((len(x0), 0))
        out = initial_states(problem, self.parameters, self.vector, x0, constants, networks)
        weights = self.zeros((len(x0), out.shape[1], self.shared)) if tape and not self.only_local else None
        called = steady_rows(problem, self.parameters, self.constants)
        rows = []
        for i in range(out.shape[1]):
            grads = gradients(out[:, i].sum(), [x0, *k, *(z for *_, z in tape)])
            rows.append(grads[: 1 + len(k)])
            if weights is not None:
                own = self.zeros((len(called), self.shared))
                self._add_weights(own, tape, grads[1 + len(k) :])
                weights[called, i] = own
        found = [torch.stack([row[j] for row in rows], 1).detach() for j in range(1 + len(k))]
        return found, None if weights is None else weights.detach()

    def add_constants(self, shared: Tensor, local: Tensor, derivatives: list[Tensor], owner: Tensor) -> None:
        """Adds derivatives by constants ([B, n] per constant, natural units) to the columns of their trainable
        values."""
        parameters = self.parameters
        known = len(parameters.model.constants)
        if parameters.shared and not self.only_local:
            for column, index in enumerate(parameters.shared):
                shared[..., parameters.n_weights + column] += derivatives[known + index] * self._slopes[0][column]
        for column, index in enumerate(parameters.own):
            local[..., column] += derivatives[known + index] * self._slopes[1][owner, column][:, None]

    @cached_property
    def _slopes(self) -> tuple[Tensor, Tensor]:
        """Derivatives of natural values by trainable ones: of shared constants [n], and of each trajectory's own
        [N, n]."""
        parameters, theta = self.parameters, self.theta
        own = theta[parameters.n_shared :].reshape(-1, parameters.n_local)[:, : len(parameters.own)]
        each = (parameters.shared, theta[parameters.places]), (parameters.own, own)
        found = [parameters.bijections(which).derivative(u) for which, u in each]
        return self.tensor(np.ascontiguousarray(found[0])), self.tensor(np.ascontiguousarray(found[1]))

    def observed(self, before: Array, scale: Array) -> Observed:
        """Derivatives of the measured channels at the states `before` [R, n_states], each times its `scale` [R, C]."""
        problem, packed = self.problem, self.problem.packed
        seen = np.nonzero(problem.seen)
        row, channel = (self.tensor(places) for places in seen)
        owner = self.tensor(packed.row_trajectory)
        states = [c.state for c in problem.model.channels if c.state is not None]
        direct = len(states) == len(problem.model.channels)
        bounds = np.searchsorted(seen[0], np.arange(packed.rows + 1))
        if direct:
            d_seen = self.zeros((len(row), self.n_states))
            d_seen[torch.arange(len(row), device=self.device), torch.tensor(states, device=self.device)[channel]] = (
                self.tensor(scale)[row, channel].to(d_seen.dtype)
            )
            return Observed(row, bounds, d_seen, None, None)
        x = self.tensor(before).detach().requires_grad_()
        tape: Taped = []
        k = [column.detach().clone().requires_grad_() for column in self.constants[owner].unbind(1)]
        networks = problem.module.torch_networks(self.weights, tape)
        constants = torch.stack(k, 1) if k else self.zeros((packed.rows, 0))
        out = self.tensor(scale) * observe_rows(problem, x, constants, networks)
        pre = [z for *_, z in tape]
        channels = out.shape[1]
        d_state = self.zeros((packed.rows, channels, self.n_states))
        d_shared = self.zeros((packed.rows, channels, self.shared))
        d_local = self.zeros((packed.rows, channels, self.parameters.n_local))
        for i in range(channels):
            grads = gradients(out[:, i].sum(), [x, *k, *pre])
            d_state[:, i] = grads[0]
            by_constants = [g[:, None] for g in grads[1 : 1 + len(k)]]
            self.add_constants(d_shared[:, i : i + 1], d_local[:, i : i + 1], by_constants, owner)
            if not self.only_local:
                self._add_weights(d_shared[:, i], tape, grads[1 + len(k) :])
        return Observed(
            row,
            bounds,
            d_state.detach()[row, channel],
            d_shared.detach()[row, channel],
            d_local.detach()[row, channel],
        )

    def _add_weights(self, target: Tensor, tape: Taped, cotangents: list[Tensor]) -> None:
        """Adds the weights' columns [B, columns] of one output; every tape entry covers the whole batch B."""
        for (network, layer, a, _), dz in zip(tape, cotangents, strict=True):
            begin, rows, width = self.offsets[network, layer]
            a, dz = a.detach().reshape(len(target), -1, width), dz.reshape(len(target), -1, rows)
            target[:, begin : begin + rows * width] += torch.bmm(dz.transpose(1, 2), a).reshape(len(target), -1)
            target[:, begin + rows * width : begin + rows * width + rows] += dz.sum(1)


@lru_cache(maxsize=64)
def starts_of_data(model: Model) -> tuple[bool, ...]:
    """Whether each state's start depends neither on learned constants nor on other starts: then its derivatives are
    known without a graph."""
    if model.steady is not None:
        return (False,)
    data = {symbol(c.name) for c in (*model.constants, *model.conditions)}
    given = [state.initial.value if state.initial.known else None for state in model.states]
    return tuple(value is None or model.inlined([value])[0].free_symbols <= data for value in given)


def gradients(output: Tensor, inputs: list[Tensor]) -> list[Tensor]:
    """Gradients of a scalar, zero for inputs that it does not depend on; the graph is kept."""
    if not output.requires_grad:
        return [torch.zeros_like(x) for x in inputs]
    found = torch.autograd.grad(output, inputs, retain_graph=True, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for g, x in zip(found, inputs, strict=True)]


def _layer_offsets(parameters: Parameters) -> dict[tuple[int, int], tuple[int, int, int]]:
    """(network, layer) -> (first column, outputs, inputs); the bias follows its weight."""
    out: dict[tuple[int, int], tuple[int, int, int]] = {}
    position = 0
    for index, network in enumerate(parameters.model.networks):
        sizes = network.sizes
        for layer in range(len(sizes) - 1):
            out[index, layer] = (position, sizes[layer + 1], sizes[layer])
            position += (sizes[layer] + 1) * sizes[layer + 1]
    return out
