"""The coordinates of the filter: logarithms of states whose disturbance is proportional to them (Lamperti).

With dX = f dt + sigma X dW (Ito), Z = ln X has dZ = (f / X - sigma^2 / 2) dt + sigma dW: its disturbance does not
depend on it, so that the filter's equations for mean and covariance need no further approximation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array, Mask
from gbspec.backends import Networks
from gbspec.ir import Model
from gbspec.training.engines.arithmetic import torch_arithmetic
from gbspec.training.problem import Problem

LEAST = 1e-12
"""States that must be positive are not taken below this where data or guesses are not."""
Field = Callable[[Any, Tensor, Tensor], Tensor]


def relative_states(model: Model) -> Mask:
    """Which states [n] are filtered as logarithms."""
    names = {d.state for d in model.diffusions if d.relative is not None}
    return np.array([state.name in names for state in model.states], dtype=np.bool_)


@dataclass(frozen=True)
class Coordinates:
    """The coordinates of a model's states; `log` [n] marks the logarithms."""

    log: Mask

    @property
    def plain(self) -> bool:
        """Whether all coordinates are the states themselves."""
        return not bool(self.log.any())

    def of(self, states: Array) -> Array:
        """The coordinates of states [..., n]."""
        return np.where(self.log, np.log(np.maximum(states, LEAST)), states)

    def states(self, z: Array) -> Array:
        """The states of coordinates [..., n]."""
        with np.errstate(over="ignore"):
            return np.where(self.log, np.exp(np.where(self.log, z, 0.0)), z)

    def torch_states(self, z: Tensor) -> Tensor:
        """The states of coordinates [n]."""
        if self.plain:
            return z
        mask = torch.from_numpy(self.log)
        return torch.where(mask, torch.exp(torch.where(mask, z, torch.zeros_like(z))), z)

    def torch_of(self, x: Tensor) -> Tensor:
        """The coordinates of states [n]."""
        if self.plain:
            return x
        mask = torch.from_numpy(self.log)
        return torch.where(mask, torch.log(torch.where(mask, x, torch.ones_like(x))), x)


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
        mask = torch.from_numpy(self.coordinates.log)

        def drift(t: Any, z: Tensor, u: Tensor) -> Tensor:
            x = self.coordinates.torch_states(z)
            rate = rhs(t, x, u)
            safe = torch.where(mask, x, torch.ones_like(x))
            return torch.where(mask, rate / safe - 0.5 * self.spread(z, u) ** 2, rate)

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
