"""The functions of sub-steps and rows, each by the way that is fastest for the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.engines.filter.forward import Forward
from gbspec.training.engines.filter.local import Arrays, Evaluated, Local, Parts, evaluate
from gbspec.training.engines.filter.values import Values


@dataclass(frozen=True)
class Functions:
    """The functions at B points with coordinates `z` [B, n], constants `k` [B, k] and the weights `w`; `forward` is
    None for models that need torch, and `values` for those that need it without derivatives too."""

    local: Local
    forward: Forward | None
    values: Values | None = None

    def field(self, z: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.field`."""
        if self.forward is not None:
            return self.forward.field(z, k, data, derivatives)
        if self.values is not None and not derivatives:
            return self.values.field(z, k, w, data)
        return _by_torch(self.local.field, z, k, w, data, derivatives)

    def dosed(self, z: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.dosed`."""
        if self.forward is not None:
            return self.forward.dosed(z, k, data, derivatives)
        return _by_torch(self.local.dosed, z, k, w, data, derivatives)

    def observation(self, z: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.observation`."""
        if self.forward is not None:
            return self.forward.observation(z, k, data, derivatives)
        if self.values is not None and not derivatives:
            return self.values.observation(z, k, w, data)
        return _by_torch(self.local.observation, z, k, w, data, derivatives)

    def tangent(self, z: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """`Local.tangent`."""
        if self.forward is not None:
            return self.forward.tangent(z, k, data, derivatives)
        return _by_torch(self.local.tangent, z, k, w, data, derivatives)

    def start(self, starts: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """Mean and covariance at the starts of trajectories, which do not depend on weights."""
        if self.forward is not None:
            return self.forward.start(starts, k, data, derivatives)
        found = _by_torch(self.local.start, starts, k, w[:0], data, derivatives)
        by_weight = tuple(np.zeros((*part.shape, len(w))) for part in found.parts)
        return Evaluated(found.parts, found.by_state, found.by_constant, by_weight)

    def factors(self, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """The matrices and disturbances of a linear model."""
        if self.forward is not None:
            return self.forward.factors(k, data, derivatives)
        return _by_torch(self.local.factors, np.zeros((len(k), 0)), k, w, data, derivatives)

    def push(self, k: Array, w: Tensor, data: Arrays, derivatives: bool) -> Evaluated:
        """What does not depend on its states."""
        if self.forward is not None:
            return self.forward.push(k, data, derivatives)
        return _by_torch(self.local.push, np.zeros((len(k), 0)), k, w, data, derivatives)


def tensors(data: Arrays) -> Parts:
    """Arrays as tensors."""
    return tuple(torch.from_numpy(np.require(part, requirements=["C", "W"])) for part in data)


def _by_torch(
    function: Callable[..., Parts], z: Array, k: Array, w: Tensor, data: Arrays, derivatives: bool
) -> Evaluated:
    return evaluate(function, torch.from_numpy(z), torch.from_numpy(k), w, tensors(data), derivatives)
