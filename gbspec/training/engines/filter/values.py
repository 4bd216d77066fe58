"""The functions of `local` without derivatives, for models with networks, in numpy: the same numbers in less time.

The search of a filter's moments evaluates few points at a time, thousands of times; torch takes most of its time there
for what surrounds an operation. Derivatives, which are taken once where the search has ended, stay with torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import LEAST, Model
from gbspec.training.engines.filter.local import Arrays, Evaluated, Local

quiet = np.errstate(all="ignore")
"""Guesses may be far off: what is not finite is marked, and searched on."""


def values_cover(model: Model) -> bool:
    """Whether equations need no vectors, tables or searches."""
    return not (model.arrays or model.tables or model.algebraics or model.steady or model.delays)


@dataclass(frozen=True)
class Values:
    """The functions of a problem's sub-steps and rows at B points."""

    local: Local

    @cached_property
    def _ops(self) -> Any:
        return self.local.problem.module.arithmetic("numpy")

    @cached_property
    def _last(self) -> dict[bytes, Any]:
        """The networks of the weights of the last call."""
        return {}

    def _networks(self, w: Tensor) -> Any:
        """The networks with the weights [w]."""
        weights = w.detach().numpy()
        key = weights.tobytes()
        if key not in self._last:
            module, own = self.local.problem.module, self.local.parameters.weights(w.detach())
            arrays = module.weights | {name: tensor.numpy() for name, tensor in own.items()}
            self._last.clear()
            self._last[key] = type(module)(arrays).numpy_networks()
        return self._last[key]

    def _constants(self, k: Array) -> tuple[Any, ...]:
        known = (float(constant.value) for constant in self.local.problem.model.constants)
        return (*known, *k.T)

    def _spread(self, x: Array, k: Array, u: Array, condition: Array) -> Array:
        equations = self.local.problem.module.equations
        found: Array = equations.diffusions(self._ops, x, condition, u, self._constants(k))
        return np.broadcast_to(found, x.shape)

    @quiet
    def field(self, z: Array, k: Array, w: Tensor, data: Arrays) -> Evaluated:
        """`Local.field`."""
        t, u, condition = data
        coordinates, equations = self.local.coordinates, self.local.problem.module.equations
        x = coordinates.states(z)
        rhs = equations.field(self._ops, condition, self._constants(k), self._networks(w))
        rate, square = np.broadcast_to(rhs(t, x, u), x.shape), self._spread(x, k, u, condition) ** 2
        if not coordinates.plain:
            rate = coordinates.drift(rate, square, z, x)
        return Evaluated((rate, square))

    @quiet
    def observation(self, z: Array, k: Array, w: Tensor, data: Arrays) -> Evaluated:
        """`Local.observation`."""
        t, u, condition = data
        equations, log = self.local.problem.module.equations, self.local.log_channels
        constants, x = self._constants(k), self.local.coordinates.states(z)
        y = equations.observe(self._ops, t, x, condition, u, constants, self._networks(w))
        y = np.broadcast_to(y, (len(z), len(log)))
        return Evaluated((np.where(log, np.log(np.where(log, np.maximum(y, LEAST), 1.0)), y),))


__all__ = ["Values", "values_cover"]
