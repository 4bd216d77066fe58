"""Smooth bijections between a constant's allowed range and the real line, so that bounds hold by construction.

Two-sided bounds use the logistic function, one-sided bounds the exponential function, and no bounds the identity scaled
by the starting value. The optimiser works with `u`, and the constant is the bijection at `STRETCH * u`: a unit step of
`u` is about a factor of e^3, because constants are few and their starting values are more often far off than those of
weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, assert_never

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Learnable

Bounds = Literal["both", "low", "high", "none"]
"""The bounds that a constant has."""

STRETCH = 3.0
MARGIN = 1e-3
"""A starting value on a bound is moved inside by this fraction of the range (the exact bound is at infinite `u`)."""


@dataclass(frozen=True)
class Bijections:
    """One bijection per learnable, evaluated together. Arrays are [n_learnables]."""

    low: Array
    high: Array
    scale: Array

    @staticmethod
    def of(learnables: tuple[Learnable, ...]) -> Bijections:
        """The bijections of a model's learnables."""
        return Bijections(
            np.array([k.range.low for k in learnables], dtype=np.float64),
            np.array([k.range.high for k in learnables], dtype=np.float64),
            np.array([abs(k.start) if k.start != 0 else 1.0 for k in learnables], dtype=np.float64),
        )

    def kind(self, i: int) -> Bounds:
        """The bounds that constant i has."""
        low, high = math.isfinite(self.low[i]), math.isfinite(self.high[i])
        return "both" if low and high else "low" if low else "high" if high else "none"

    def to_natural(self, u: Tensor) -> Tensor:
        """Natural values [..., n] of trainable values `u` [..., n]."""
        raw = STRETCH * u
        parts = []
        for i in range(len(self.low)):
            match self.kind(i):
                case "both":
                    value = self.low[i] + (self.high[i] - self.low[i]) * torch.sigmoid(raw[..., i])
                case "low":
                    value = self.low[i] + self.scale[i] * torch.exp(raw[..., i])
                case "high":
                    value = self.high[i] - self.scale[i] * torch.exp(raw[..., i])
                case "none":
                    value = self.scale[i] * raw[..., i]
                case unknown:
                    assert_never(unknown)
            parts.append(value)
        return torch.stack(parts, -1) if parts else u

    def derivative(self, u: Array) -> Array:
        """d natural / d u, elementwise."""
        x = torch.tensor(u, dtype=torch.float64, requires_grad=True)
        if x.shape[-1] == 0:
            return np.zeros_like(u)
        (slope,) = torch.autograd.grad(self.to_natural(x).sum(), x)
        return np.asarray(slope.numpy(), dtype=np.float64)

    def from_natural(self, value: Array) -> Array:
        """Trainable values of natural ones [..., n]; values on or beyond a bound are moved inside."""
        out = np.empty_like(value, dtype=np.float64)
        for i in range(len(self.low)):
            v, low, high, scale = value[..., i], self.low[i], self.high[i], self.scale[i]
            match self.kind(i):
                case "both":
                    fraction = np.clip((v - low) / (high - low), MARGIN, 1 - MARGIN)
                    raw = np.log(fraction / (1 - fraction))
                case "low":
                    raw = np.log(np.maximum((v - low) / scale, MARGIN))
                case "high":
                    raw = np.log(np.maximum((high - v) / scale, MARGIN))
                case "none":
                    raw = v / scale
                case unknown:
                    assert_never(unknown)
            out[..., i] = raw / STRETCH
        return out
