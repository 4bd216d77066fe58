"""What a model does in sub-steps and rows, as functions of coordinates at points, with exact derivatives, all at once.

`Local` has the functions for one point; `evaluate` takes them at many points side by side, with their derivatives in
the coordinates, constants and weights. How moments follow from these is in `sigma.py` and `flows.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
    """The functions of a problem's sub-steps and rows. `linear`: how the model is linear, if it is."""

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

    def field(self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, u: Tensor, condition: Tensor) -> Parts:
        """The drift [n] and the squares of the disturbances [n] at coordinates `z` [n]."""
        dynamics = self.dynamics(condition, k, w)
        return dynamics.field()(t, z, u), dynamics.spread(z, u) ** 2

    def dosed(self, z: Tensor, k: Tensor, w: Tensor, doses: Tensor, condition: Tensor) -> Parts:
        """The coordinates [n] after doses."""
        return (self.dynamics(condition, k, w).dosed(z, doses),)

    @property
    def _ops(self) -> Any:
        return torch_arithmetic(self.problem.module)

    def observation(self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, u: Tensor, condition: Tensor) -> Parts:
        """Predicted channels [C] of a row."""
        return (self.dynamics(condition, k, w).observed(t, z, u, self.log_channels),)

    def tangent(self, z: Tensor, k: Tensor, w: Tensor, t: Tensor, u: Tensor, condition: Tensor) -> Parts:
        """Predicted channels [C] of a row and their derivatives [C, n]."""
        dynamics = self.dynamics(condition, k, w)
        slopes, y = _with_jacobian(lambda x: dynamics.observed(t, x, u, self.log_channels), z)
        return y, slopes

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
