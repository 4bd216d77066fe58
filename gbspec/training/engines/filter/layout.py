"""The parameters of the likelihood and the columns of its sensitivities."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from gbspec.arrays import Array
from gbspec.training.engines.filter.local import Arrays, Evaluated
from gbspec.training.problem import STRETCH, Integers, Parameters


@dataclass(frozen=True)
class Layout:
    """The vector of the likelihood: the trainable vector [size], then `noises` logarithms of standard deviations.

    Sensitivities have a column for each entry that all trajectories share (weights, constants, noises) and for each
    that a trajectory has for itself (its constants, its learned initial states).
    """

    parameters: Parameters
    noises: int

    @property
    def size(self) -> int:
        """The length of the vector."""
        return self.parameters.size + self.noises

    @property
    def shared(self) -> int:
        """The number of shared columns."""
        return self.parameters.n_shared + self.noises

    @cached_property
    def states(self) -> Integers:
        """The states whose initial values are learned for some trajectory."""
        return np.flatnonzero(self.parameters.start_free.any(axis=0)).astype(np.int64)

    @property
    def width(self) -> int:
        """The number of columns."""
        return self.shared + len(self.parameters.own) + len(self.states)

    def split(self, vector: Array) -> tuple[Array, Array]:
        """The trainable vector, and the logarithms of standard deviations."""
        return vector[: self.parameters.size], vector[self.parameters.size :]

    @cached_property
    def places(self) -> Integers:
        """The entry of the vector that each column of each trajectory belongs to [N, width]."""
        parameters, count = self.parameters, self.parameters.trajectories
        shared = np.concatenate([np.arange(parameters.n_shared), parameters.size + np.arange(self.noises)])
        begin = parameters.n_shared + np.arange(count)[:, None] * parameters.n_local
        own = begin + np.arange(len(parameters.own))
        starts = begin + len(parameters.own) + self.states
        return np.concatenate([np.broadcast_to(shared, (count, len(shared))), own, starts], axis=1).astype(np.int64)

    @cached_property
    def free(self) -> Array:
        """1 for the entries of the vector that are fitted [size]."""
        return np.concatenate([self.parameters.free, np.ones(self.noises)])


@dataclass(frozen=True)
class At:
    """The natural values at a vector: learnable constants `k` [N, k], weights `w`, starts [N, n], and the slopes of
    constants and starts in their entries [N, k] and [n]."""

    layout: Layout
    k: Array
    w: torch.Tensor
    starts: Array
    k_slopes: Array
    start_slopes: Array

    @classmethod
    def of(cls, layout: Layout, theta: Array) -> At:
        """The values at a trainable vector."""
        parameters, vector = layout.parameters, torch.from_numpy(theta)
        known = len(parameters.model.constants)
        with torch.no_grad():
            k = parameters.constants(vector)[:, known:].numpy().copy()
            starts = parameters.starts(vector).numpy().copy()
        slopes = np.ones(k.shape)
        if parameters.shared:
            entries = theta[parameters.n_weights : parameters.n_shared]
            slopes[:, list(parameters.shared)] = parameters.bijections(parameters.shared).derivative(entries)
        if parameters.own:
            block = theta[parameters.n_shared :].reshape(-1, parameters.n_local)[:, : len(parameters.own)]
            slopes[:, list(parameters.own)] = parameters.bijections(parameters.own).derivative(block.copy())
        scale = STRETCH * parameters.start_scale
        return cls(layout, k, vector[: parameters.n_weights].clone(), starts, slopes, scale)

    def columns(self, evaluated: Evaluated, owner: Integers) -> list[Array]:
        """The derivatives of the parts of a function at points of the trajectories `owner` in all columns
        [B, ..., width]; those of starts are zero."""
        return [
            self._part(constant, evaluated.by_weight, index, owner)
            for index, constant in enumerate(evaluated.by_constant)
        ]

    def _part(self, natural: Array, by_weight: Arrays, index: int, owner: Integers) -> Array:
        layout, parameters = self.layout, self.layout.parameters
        out = np.zeros((*natural.shape[:-1], layout.width))
        if parameters.n_weights:
            out[..., : parameters.n_weights] = by_weight[index]
        slopes = self.k_slopes[owner].reshape(-1, *(1,) * (natural.ndim - 2), natural.shape[-1])
        entries = natural * slopes
        out[..., parameters.n_weights : parameters.n_shared] = entries[..., list(parameters.shared)]
        out[..., layout.shared : layout.shared + len(parameters.own)] = entries[..., list(parameters.own)]
        return out
