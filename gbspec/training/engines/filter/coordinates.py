"""The coordinates of the filter: those of `ir.Coordinate`, in which disturbances do not depend on the states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.backends import Networks
from gbspec.ir import LEAST, Coordinate, Model, coordinates_of
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.problem import Problem

Field = Callable[[Any, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Coordinates:
    """The coordinates of a model's states [n]."""

    each: tuple[Coordinate, ...]

    @classmethod
    def of_model(cls, model: Model) -> Coordinates:
        """The coordinates in which the disturbances do not depend on the states, where there are any."""
        return cls(coordinates_of(model))

    @cached_property
    def plain(self) -> bool:
        """Whether all coordinates are the states themselves."""
        return all(each.plain for each in self.each)

    @cached_property
    def log(self) -> Mask:
        """Which coordinates [n] are logarithms."""
        return np.array([each.logarithm for each in self.each], dtype=np.bool_)

    @cached_property
    def bent(self) -> Mask:
        """Which coordinates [n] are logarithms or logits, whose typical size is 1."""
        return np.array([not each.plain for each in self.each], dtype=np.bool_)

    def of(self, states: Array) -> Array:
        """The coordinates of states [..., n]; states that have none are moved to the nearest that have."""
        parts = [each.of(np.log, each.inside(states[..., i])) for i, each in enumerate(self.each)]
        return np.stack(parts, axis=-1)

    def well_inside(self, states: Array, sizes: Array) -> Array:
        """States [..., n] with those that have no coordinate moved to where they have one, by a hundredth of their
        typical sizes, or of the range."""
        parts = [each.well_inside(states[..., i], sizes[..., i]) for i, each in enumerate(self.each)]
        return np.stack(parts, axis=-1)

    def slopes(self, states: Array) -> Array:
        """The derivatives of coordinates by states [..., n]."""
        parts = [each.slope(each.inside(states[..., i])) for i, each in enumerate(self.each)]
        return np.stack(parts, axis=-1)

    def spreads(self, states: Array, sizes: Array, least: float) -> Array:
        """The standard deviations [..., n] of states whose sizes are typically so far from `states`: of those with
        another coordinate the standard deviation of this (at least `least`), times what the state moves with it."""
        parts = [each.spread(each.inside(states[..., i]), sizes[..., i], least) for i, each in enumerate(self.each)]
        return np.stack(parts, axis=-1)

    def states(self, z: Array) -> Array:
        """The states of coordinates [..., n]."""
        if self.plain:
            return z
        with np.errstate(over="ignore"):
            return np.stack([each.state(np.exp, z[..., i]) for i, each in enumerate(self.each)], axis=-1)

    def drift(self, rate: Array, square: Array, z: Array, x: Array) -> Array:
        """The drift of coordinates [..., n]: `Coordinate.drift` of each."""
        parts = (rate, square, z, x)
        return np.stack([c.drift(np.exp, *(part[..., i] for part in parts)) for i, c in enumerate(self.each)], axis=-1)

    def torch_states(self, z: Tensor) -> Tensor:
        """The states of coordinates [n]."""
        if self.plain:
            return z
        return torch.stack([each.state(torch.exp, z[..., i]) for i, each in enumerate(self.each)], dim=-1)

    def torch_of(self, x: Tensor) -> Tensor:
        """The coordinates of states [n]."""
        if self.plain:
            return x
        return torch.stack([each.of(torch.log, x[..., i]) for i, each in enumerate(self.each)], dim=-1)

    def torch_drift(self, rate: Tensor, square: Tensor, z: Tensor, x: Tensor) -> Tensor:
        """The drift of coordinates [n]."""
        parts = (rate, square, z, x)
        found = [c.drift(torch.exp, *(part[..., i] for part in parts)) for i, c in enumerate(self.each)]
        return torch.stack(found, dim=-1)


@dataclass(frozen=True)
class Dynamics:
    """Drift and disturbance of a model in the filter's coordinates, for one trajectory; differentiable."""

    problem: Problem
    coordinates: Coordinates
    condition: Tensor
    constants: tuple[Tensor, ...]
    networks: Networks

    @property
    def _ops(self) -> Any:
        return torch_arithmetic(self.problem.module)

    def spread(self, z: Tensor, u: Tensor) -> Tensor:
        """The sizes of the disturbances [n] of the coordinates."""
        x = self.coordinates.torch_states(z)
        found: Tensor = self.problem.module.equations.diffusions(
            self._ops, x, self.condition.unbind(-1), u.unbind(-1), self.constants
        )
        return found

    def field(self) -> Field:
        """The drift of the coordinates as a function of time, coordinates and inputs."""
        rhs = self.problem.module.equations.field(self._ops, self.condition.unbind(-1), self.constants, self.networks)
        if self.coordinates.plain:
            return rhs  # type: ignore[no-any-return]

        def drift(t: Any, z: Tensor, u: Tensor) -> Tensor:
            x = self.coordinates.torch_states(z)
            return self.coordinates.torch_drift(rhs(t, x, u), self.spread(z, u) ** 2, z, x)

        return drift

    def dosed(self, z: Tensor, amounts: Tensor) -> Tensor:
        """The coordinates after doses of these amounts [..., kinds]."""
        model = self.problem.model
        terms = self.problem.module.equations.doses(self._ops, self.condition.unbind(-1), self.constants)
        x = self.coordinates.torch_states(z)
        places = torch.eye(len(model.states), dtype=z.dtype)
        for kind, (fraction, _) in enumerate(terms):
            arriving = amounts[..., kind] * fraction
            x = x + arriving[..., None] * places[model.state_index[model.doses[kind].state]]
        return self.coordinates.torch_of(x)

    def observed(self, t: Tensor, z: Tensor, u: Tensor, log: Mask) -> Tensor:
        """The predicted channels [C]; logarithms where `log` [C]."""
        x = self.coordinates.torch_states(z)
        y: Tensor = self.problem.module.equations.observe(
            self._ops, t, x, self.condition.unbind(-1), u.unbind(-1), self.constants, self.networks
        )
        if not log.any():
            return y
        mask = torch.from_numpy(log)
        return torch.where(mask, torch.log(torch.where(mask, torch.clamp(y, min=LEAST), torch.ones_like(y))), y)
