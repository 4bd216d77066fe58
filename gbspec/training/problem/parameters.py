"""The trainable vector and its conversion to and from weights, constants and initial states.

Order: network weights (network by network, layer by layer, weight row by row, then bias), shared constants, what
distributions and noises imply (`Model.implied`), then one block per trajectory: its own constants and its initial
state. All entries are float64 and scaled such that a change by 1 is large.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.training.problem.arrivals import Integers
from gbspec.training.problem.bounds import STRETCH, Bijections

Weights = dict[str, Array]


@dataclass(frozen=True)
class Parameters:
    """Layout and scales of the trainable vector for N trajectories of a model.

    `start_value` [N, n_states] and `start_scale` [n_states]: a learned initial state is
    `start_value + STRETCH * start_scale * u`; `start_free` [N, n_states] is 1 for learned ones. Where that is so of a
    state whose initial value the model gives, all states of the trajectory start at the values of this table, as those
    of a later segment do. `fixed` are the arrays of the weights file that training does not change (the networks'
    scales).
    """

    model: Model
    start_value: Array
    start_scale: Array
    start_free: Array
    fixed: Weights

    # ---------------------------------------------------------------- sizes
    @property
    def trajectories(self) -> int:
        """Number of trajectories."""
        return int(self.start_value.shape[0])

    @cached_property
    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the networks' trained arrays, in order."""
        shapes: dict[str, tuple[int, ...]] = {}
        for network in self.model.networks:
            sizes = network.sizes
            for layer, (a, b) in enumerate(pairwise(sizes)):
                shapes[f"network.{network.name}.{layer}.weight"] = (b, a)
                shapes[f"network.{network.name}.{layer}.bias"] = (b,)
        return shapes

    @cached_property
    def n_weights(self) -> int:
        """Number of network weights, with those of splines, whose coefficients are biases: nothing depends on these."""
        return sum(math.prod(shape) for shape in self.weight_shapes.values())

    @cached_property
    def shared(self) -> tuple[int, ...]:
        """Indices (among the learnables) of the constants that all trajectories share."""
        return tuple(i for i, k in enumerate(self.model.learnables) if not k.per_trajectory)

    @cached_property
    def own(self) -> tuple[int, ...]:
        """Indices (among the learnables) of the constants that each trajectory has for itself."""
        return tuple(i for i, k in enumerate(self.model.learnables) if k.per_trajectory)

    @property
    def n_shared(self) -> int:
        """Number of columns that all trajectories share: weights, shared constants, and what these imply."""
        return self.n_weights + len(self.shared) + len(self.model.implied)

    @property
    def places(self) -> slice:
        """Where the vector has the shared constants."""
        return slice(self.n_weights, self.n_weights + len(self.shared))

    @property
    def implied_places(self) -> slice:
        """Where the vector has what distributions and noises imply."""
        return slice(self.places.stop, self.n_shared)

    @property
    def n_local(self) -> int:
        """Number of columns in each trajectory's block: own constants and initial state."""
        return len(self.own) + len(self.model.states)

    @property
    def size(self) -> int:
        """Length of the vector."""
        return self.n_shared + self.trajectories * self.n_local

    @property
    def free(self) -> Array:
        """1 for entries of the vector that are trained, 0 for fixed ones [size]."""
        out = np.ones(self.size)
        local = out[self.n_shared :].reshape(self.trajectories, self.n_local)
        local[:, len(self.own) :] = self.start_free
        return out

    @cached_property
    def given(self) -> Integers:
        """The trajectories that start as the model says; others start at values of their own."""
        known = np.array([state.initial.known for state in self.model.states], dtype=bool)
        return np.flatnonzero(~(self.start_free[:, known] > 0).any(axis=1))

    def bijections(self, indices: tuple[int, ...]) -> Bijections:
        """Bounds of some of the learnables; of those of single trajectories, what their distributions allow."""
        if indices not in self._bijections:
            self._bijections[indices] = Bijections.of(tuple(self.model.learnables[i].individual for i in indices))
        return self._bijections[indices]

    @cached_property
    def _bijections(self) -> dict[tuple[int, ...], Bijections]:
        """The maps that were asked for: every solution needs them."""
        return {}

    @cached_property
    def implied(self) -> Bijections:
        """Bounds of what distributions and noises imply."""
        return Bijections.of(self.model.implied)

    # ---------------------------------------------------------------- natural values from the vector
    def local(self, theta: Tensor) -> Tensor:
        """The trajectories' blocks [N, n_local]."""
        return theta[self.n_shared :].reshape(self.trajectories, self.n_local)

    def weights(self, theta: Tensor) -> dict[str, Tensor]:
        """The arrays of the module's networks: trained ones as views of `theta`, and the fixed scales."""
        out: dict[str, Tensor] = {
            k: torch.as_tensor(v, dtype=theta.dtype, device=theta.device) for k, v in self.fixed.items()
        }
        # One split operation: the backward pass of separate slices would create a vector of full length for each.
        shapes = self.weight_shapes
        parts = torch.split(theta[: self.n_weights], [math.prod(shape) for shape in shapes.values()])
        out |= {name: part.reshape(shape) for (name, shape), part in zip(shapes.items(), parts, strict=True)}
        return out

    def constants(self, theta: Tensor) -> Tensor:
        """All constants of every trajectory, known ones first [N, n_constants]."""
        known = self._known.to(theta)
        shared = self.bijections(self.shared).to_natural(theta[self.places])
        same = torch.cat([known, shared]).expand(self.trajectories, -1)
        if not self.own:
            return same
        own = self.bijections(self.own).to_natural(self.local(theta)[:, : len(self.own)])
        order = np.argsort([*range(len(known)), *(len(known) + i for i in (*self.shared, *self.own))])
        return torch.cat([same, own], 1)[:, torch.from_numpy(order)]

    @cached_property
    def _known(self) -> Tensor:
        """The values of the constants that are not learned."""
        return torch.tensor([c.value for c in self.model.constants], dtype=torch.float64)

    def starts(self, theta: Tensor) -> Tensor:
        """Initial states [N, n_states], before those given by expressions are substituted."""
        u = self.local(theta)[:, len(self.own) :]
        value = torch.as_tensor(self.start_value, dtype=theta.dtype, device=theta.device)
        scale = torch.as_tensor(STRETCH * self.start_scale * self.start_free, dtype=theta.dtype, device=theta.device)
        return torch.addcmul(value, scale, u)

    # ---------------------------------------------------------------- the vector from natural values
    def vector(self, weights: Mapping[str, Array], constants: Array | None = None) -> Array:
        """The vector for given weights, learnable constants ([n] or [N, n], natural) and initial states
        `start_value`."""
        theta = np.zeros(self.size)
        parts = [np.asarray(weights[name], dtype=np.float64).ravel() for name in self.weight_shapes]
        theta[: self.n_weights] = np.concatenate([*parts, np.zeros(0)])
        values = (
            np.array([k.start for k in self.model.learnables], dtype=np.float64) if constants is None else constants
        )
        table = np.broadcast_to(values, (self.trajectories, len(self.model.learnables)))
        if self.shared:
            natural = np.median(table[:, list(self.shared)], axis=0) if self.trajectories else values[list(self.shared)]
            theta[self.places] = self.bijections(self.shared).from_natural(natural)
        if self.model.implied:
            starts = np.array([k.start for k in self.model.implied], dtype=np.float64)
            theta[self.implied_places] = self.implied.from_natural(starts)
        if self.own:
            local = theta[self.n_shared :].reshape(self.trajectories, self.n_local)
            local[:, : len(self.own)] = self.bijections(self.own).from_natural(table[:, list(self.own)].copy())
        return theta

    def with_starts(self, theta: Array, starts: Array) -> Array:
        """The vector with the learned initial states set to `starts` [N, n_states] (fixed ones are unchanged)."""
        out = theta.copy()
        local = out[self.n_shared :].reshape(self.trajectories, self.n_local)
        scale = STRETCH * self.start_scale
        local[:, len(self.own) :] = np.where(self.start_free > 0, (starts - self.start_value) / scale, 0.0)
        return out

    def take(self, indices: Integers) -> Parameters:
        """The layout for some of the trajectories."""
        return replace(self, start_value=self.start_value[indices], start_free=self.start_free[indices])

    def take_vector(self, theta: Array, indices: Integers) -> Array:
        """The vector for some of the trajectories: the shared part and their blocks."""
        local = theta[self.n_shared :].reshape(self.trajectories, self.n_local)
        return np.concatenate([theta[: self.n_shared], local[indices].ravel()])

    def medians(self, theta: Array) -> dict[str, float]:
        """The medians of the constants that have a distribution between trajectories, by name (of effects: 0)."""
        with torch.no_grad():
            values = self.implied.to_natural(torch.from_numpy(np.asarray(theta)[self.implied_places])).numpy()
        found = dict(zip((k.name for k in self.model.implied), map(float, values), strict=True))
        each = [(k.name, k.distribution) for k in self.model.distributed if k.distribution is not None]
        return {name: found[made.median] if made.median else 0.0 for name, made in each}

    # ---------------------------------------------------------------- what is written to a run
    def natural(self, theta: Array) -> Weights:
        """The content of a weights file: network arrays and scales, constants, learned initial states."""
        vector = torch.as_tensor(theta, dtype=torch.float64)
        out = {name: value.numpy().astype(np.float64) for name, value in self.weights(vector).items()}
        constants = self.constants(vector).numpy()
        names = self.model.constant_names
        known = len(self.model.constants)
        # A constant per trajectory is stored in full; its entry in `constants` is the mean over trajectories, or the
        # median of its distribution.
        out["constants"] = constants.mean(axis=0) if self.trajectories else np.zeros(len(names))
        medians = self.medians(theta)
        for i in range(len(self.model.learnables)):
            column = constants[:, known + i]
            if i in self.own:
                out[f"per_trajectory.{names[known + i]}"] = column.copy()
                out["constants"][known + i] = medians.get(names[known + i], out["constants"][known + i])
            elif self.trajectories:
                out["constants"][known + i] = column[0]
        for i, constant in enumerate(self.model.constants):
            out["constants"][i] = constant.value
        out["initial"] = np.array(self.starts(vector).numpy(), dtype=np.float64)
        return out
