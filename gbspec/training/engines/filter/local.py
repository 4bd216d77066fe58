"""Legs and observations as functions of the moments at their starts, with exact derivatives, all at once.

Mean and covariance of a leg follow from those at its start (m, P) by

    m' = Phi(m),    P' = A P A^T + Q,    A = dPhi/dm,

sub-step by sub-step: Phi is a step of the solver, A its exact derivative, and Q the integral of A(h, s) S S^T A(h, s)^T
over the sub-step by Simpson's rule, with A(h, h/2) from the cubic through the values and slopes of A(h, s) at both ends
(A and -A F at the start, 1 and -F at the end). Q is a sum of squares, so that P stays positive definite, and of the
order 4 in the length of the sub-step. Phi, A and Q depend on m, the constants and the weights, not on P: everything
about a leg is computed for all legs together, and only small matrices are multiplied one after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import jacfwd, jacrev, vmap

from gbspec.arrays import Array, Mask
from gbspec.ir import Linear
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.engines.filter.coordinates import Coordinates, Dynamics
from gbspec.training.problem import Parameters, Problem

Parts = tuple[Tensor, ...]
Arrays = tuple[Array, ...]
Function = Callable[..., Parts]
"""A function of coordinates [n], learnable constants [k], weights [w] and the data of one leg or row."""


@dataclass(frozen=True)
class Local:
    """The functions of a problem's sub-steps and rows, for one of them (`step`, `observation`, `start`, `factors`,
    `push`) or without derivatives for many (`moved`, `observed`). `linear`: how the model is linear, if it is."""

    problem: Problem
    parameters: Parameters
    coordinates: Coordinates
    log_channels: Mask
    linear: Linear | None

    def dynamics(self, condition: Tensor, k: Tensor, w: Tensor) -> Dynamics:
        """Drift and disturbance with these learnable constants [k] and weights [w]."""
        known = [k.new_tensor(constant.value) for constant in self.problem.model.constants]
        weights = self.parameters.weights(w)
        networks = self.problem.module.torch_networks(weights)
        return Dynamics(self.problem, self.coordinates, condition, (*known, *k.unbind(-1)), networks)

    def step(
        self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, h: Tensor, u: Tensor, doses: Tensor, condition: Tensor
    ) -> Parts:
        """Mean [n], transition [n, n] and added covariance [n, n] at the end of a sub-step from `z` [n] before its
        doses."""
        dynamics, equations, ops = self.dynamics(condition, k, w), self.problem.module.equations, self._ops
        field, nodes, grid = dynamics.field(), u.unbind(-2), equations.grid(self._ops, t, h)
        jump = None
        if doses.shape[-1]:
            jump, z = _with_jacobian(lambda x: dynamics.dosed(x, doses), z)

        def forward(x: Tensor) -> tuple[Tensor, Tensor]:
            return equations.step(ops, field, grid, x, nodes), field(t, x, nodes[0])

        (a, first), (end, _) = jacfwd(lambda x: (forward(x),) * 2, has_aux=True)(z)
        last = jacfwd(lambda x: field(t + h, x, nodes[-1]))(end)
        q = self._added(dynamics, (z, end), nodes, h, (a, first, last))
        return end, a if jump is None else a @ jump, q

    def moved(self, z: Tensor, k: Tensor, w: Tensor, data: Parts) -> tuple[Parts, Tensor]:
        """Mean, transition and added covariance at the ends of B legs of D sub-steps from `z` [B, n], and the
        coordinates at the starts of their sub-steps [B, D, n]; without derivatives."""
        t, h, u, doses, condition = data
        dynamics, equations, ops = self.dynamics(condition, k, w), self.problem.module.equations, self._ops
        field, n = dynamics.field(), z.shape[-1]
        a, q, starts = torch.eye(n, dtype=z.dtype).expand(len(z), n, n), z.new_zeros((len(z), n, n)), []
        for s in range(t.shape[1]):
            starts.append(z)
            if doses.shape[-1]:
                z, jump = _rows(partial(_second, dynamics.dosed, doses[:, s]), z)
                a, q = jump @ a, jump @ q @ jump.transpose(1, 2)
            nodes, grid = u[:, s].unbind(1), equations.grid(ops, t[:, s], h[:, s])
            _, first = _rows(partial(_between, field, t[:, s], nodes[0]), z)
            end, step = _rows(partial(_stepped, partial(equations.step, ops, field, grid), nodes), z)
            _, last = _rows(partial(_between, field, t[:, s] + h[:, s], nodes[-1]), end)
            with torch.no_grad():
                more = self._added(dynamics, (z, end), nodes, h[:, s], (step, first, last))
                a, q, z = step @ a, step @ q @ step.transpose(1, 2) + more, end
        return (z, a, q), torch.stack(starts, 1)

    def _added(self, dynamics: Dynamics, ends: Parts, nodes: Parts, h: Tensor, slopes: Parts) -> Tensor:
        """The covariance that disturbances add in a sub-step between the coordinates `ends`; `slopes` are the
        derivative of the step and those of the drift at both ends."""
        (z, end), (a, first, last) = ends, slopes
        one, size = torch.eye(z.shape[-1], dtype=z.dtype), h[..., None, None]
        middle = 0.5 * (a + one) + 0.125 * size * (last - a @ first)
        between = nodes[self.middle] if self.middle is not None else 0.5 * (nodes[0] + nodes[-1])
        places = (z, nodes[0]), (0.5 * (z + end), between), (end, nodes[-1])
        terms = [m * dynamics.spread(*at)[..., None, :] for m, at in zip((a, middle, one), places, strict=True)]
        squares = [weight * x @ x.transpose(-1, -2) for weight, x in zip((1 / 6, 4 / 6, 1 / 6), terms, strict=True)]
        total: Tensor = size * (squares[0] + squares[1] + squares[2])
        return total

    @property
    def _ops(self) -> Any:
        return torch_arithmetic(self.problem.module)

    @property
    def middle(self) -> int | None:
        """Which of the method's nodes is the middle of a sub-step."""
        nodes = self.problem.packed.nodes
        return nodes.index(0.5) if 0.5 in nodes else None

    def observation(self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, u: Tensor, condition: Tensor) -> Parts:
        """Predicted channels [C] of a row and their derivatives [C, n]."""
        dynamics = self.dynamics(condition, k, w)
        slopes, y = _with_jacobian(lambda x: dynamics.observed(t, x, u, self.log_channels), z)
        return y, slopes

    def observed(self, z: Tensor, k: Tensor, w: Tensor, data: Parts) -> Parts:
        """Predicted channels [B, C] of rows and their derivatives [B, C, n]; without further derivatives."""
        t, u, condition = data
        dynamics = self.dynamics(condition, k, w)
        return _rows(lambda x: dynamics.observed(t, x, u, self.log_channels), z)

    def factors(self, z: Tensor, k: Tensor, w: Tensor, u: Tensor, condition: Tensor) -> Parts:
        """The derivatives [n, n] of a linear model's balances with respect to its states, and the sizes of the
        disturbances [n]; `z` is empty."""
        dynamics = self.dynamics(condition, k, w)
        drift, zero = dynamics.field(), k.new_zeros(len(self.problem.model.states))
        found: Any = jacfwd(lambda x: drift(k.new_zeros(()), x, u))(zero)
        return found, dynamics.spread(zero, u)

    def push(
        self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, h: Tensor, u: Tensor, doses: Tensor, condition: Tensor
    ) -> Parts:
        """The coefficients of b(s) = b0 + b1 s + b2 s^2 in a linear model's x' = F x + b(s), or b0 alone where nothing
        varies in a sub-step, and what doses add at its start; `z` is empty."""
        dynamics = self.dynamics(condition, k, w)
        drift, zero = dynamics.field(), k.new_zeros(len(self.problem.model.states))
        added = dynamics.dosed(zero, doses) if doses.shape[-1] else zero
        begin = drift(t, zero, u[0])
        if self.steady:
            return begin, added
        middle, end = drift(t + 0.5 * h, zero, 0.5 * (u[0] + u[-1])), drift(t + h, zero, u[-1])
        length = torch.where(h > 0, h, torch.ones_like(h))
        first = (4 * middle - 3 * begin - end) / length
        return begin, first, 2 * (begin - 2 * middle + end) / length**2, added

    @property
    def steady(self) -> bool:
        """Whether nothing varies within a sub-step of a linear model."""
        return self.linear is not None and self.linear.steady

    def start(self, starts: Tensor, k: Tensor, w: Tensor, variance: Tensor, condition: Tensor) -> Parts:
        """Mean and covariance of a trajectory's coordinates at its start, from starts [n] with this `variance` [n]."""
        ops, known = self._ops, self.problem.model.constants
        constants = (*(k.new_tensor(constant.value) for constant in known), *k.unbind())

        def initial(x: Tensor) -> Tensor:
            inserted = self.problem.module.equations.initial(ops, x, condition.unbind(-1), constants)
            return self.coordinates.torch_of(inserted)

        slopes, z = _with_jacobian(initial, starts)
        return z, (slopes * variance) @ slopes.T


def _second(function: Callable[[Tensor, Tensor], Tensor], given: Tensor, x: Tensor) -> Tensor:
    return function(x, given)


def _between(field: Callable[..., Tensor], t: Tensor, u: Tensor, x: Tensor) -> Tensor:
    return field(t, x, u)


def _stepped(step: Callable[..., Tensor], nodes: Parts, x: Tensor) -> Tensor:
    return step(x, nodes)


def _rows(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Values [B, m] of a function of separate rows [B, n], and its derivatives [B, m, n]."""
    x = at.detach().requires_grad_()
    with torch.enable_grad():
        value = function(x)
        if not value.requires_grad:
            return value, value.new_zeros((*value.shape, x.shape[1]))
        rows = [
            torch.autograd.grad(value[:, i].sum(), x, retain_graph=i + 1 < value.shape[1], allow_unused=True)[0]
            for i in range(value.shape[1])
        ]
    found = [torch.zeros_like(at) if row is None else row for row in rows]
    return value.detach(), torch.stack(found, 1) if found else value.new_zeros((*value.shape, at.shape[1]))


def _with_jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Derivative and value of a function of a vector."""

    def twice(x: Tensor) -> tuple[Tensor, Tensor]:
        value = function(x)
        return value, value

    found: Any = jacfwd(twice, has_aux=True)(at)
    return found[0], found[1]


@dataclass(frozen=True)
class Evaluated:
    """The parts of a function for B points, and where asked their derivatives with respect to coordinates
    [B, ..., n], learnable constants [B, ..., k] and weights [B, ..., w]."""

    parts: Arrays
    by_state: Arrays = ()
    by_constant: Arrays = ()
    by_weight: Arrays = ()


def evaluate(function: Function, z: Tensor, k: Tensor, w: Tensor, data: Parts, derivatives: bool) -> Evaluated:
    """A function at points with coordinates `z` [B, n] and constants `k` [B, k], the same weights `w`, and data
    [B, ...]."""
    axes = (0, 0, None, *(0 for _ in data))
    with torch.no_grad():
        if not derivatives:
            return Evaluated(numbers(vmap(function, in_dims=axes)(z, k, w, *data)))

        def twice(*arguments: Tensor) -> tuple[Parts, Parts]:
            value = function(*arguments)
            return value, value

        # Backwards with networks: weights are many, and not every activation can be differentiated forwards twice.
        jacobian = jacrev if len(w) else jacfwd
        tables = (z, k, w)
        wanted = tuple(i for i, table in enumerate(tables) if table.shape[-1])
        if wanted:
            found, parts = vmap(jacobian(twice, argnums=wanted, has_aux=True), in_dims=axes)(*tables, *data)
        else:
            found, parts = (), vmap(function, in_dims=axes)(*tables, *data)
        values = numbers(parts)
        columns = [
            tuple(
                found[part][wanted.index(i)].numpy() if i in wanted else np.zeros((*values[part].shape, 0))
                for part in range(len(values))
            )
            for i in range(len(tables))
        ]
        return Evaluated(values, *columns)


def numbers(parts: Parts) -> Arrays:
    """Tensors as arrays."""
    return tuple(part.numpy() for part in parts)
