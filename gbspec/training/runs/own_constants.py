"""What a new trajectory of a model with disturbances has of its own: the likelihood of its rows, by scoring steps.

What all trajectories share is held as learned. The values that the training has found for its trajectories are the
prior: a normal distribution of the next one (`spread_of_next`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from gbspec.arrays import Array, Mask
from gbspec.runs import spread_of_next
from gbspec.training.engines import Filtered, FilterEngine
from gbspec.training.problem import STRETCH, Integers, Weights

STEPS, ATTEMPTS = 40, 12
"""The most steps, and dampings that are tried in each."""
LONGEST = 1.0
"""The largest change of an entry in one step, in the units in which it is trained."""
SMALL = 1e-6
"""The steps end when the next one promises less of the log likelihood."""
WEAK = 1e-8
"""The least precision of an entry in these units: data and prior may say nothing."""


@dataclass(frozen=True)
class Own:
    """What was estimated of new trajectories: its `places` [N, m] in the vector, roots [N, m, m] of its covariance in
    the units in which it is trained, and how it follows the entries that all trajectories share [N, m, shared]."""

    places: Integers
    roots: Array
    follows: Array

    def columns(self, size: int) -> list[Array]:
        """Changes of the vector [size] whose outer products add up to the covariance; trajectories move together."""
        out = []
        for column in range(self.places.shape[1]):
            change = np.zeros(size)
            change[self.places] = self.roots[:, :, column]
            out.append(change)
        return out

    def followed(self, change: Array) -> Array:
        """A change of the vector in which what was estimated follows that of the shared entries."""
        out = change.copy()
        out[self.places] += self.follows @ change[: self.follows.shape[2]]
        return out


@dataclass(frozen=True)
class _Fit:
    """The objective of what `new` trajectories have of their own, given what is `seen` [R, C] of them."""

    engine: FilterEngine
    seen: Mask
    new: Sequence[int]
    weights: Weights

    @cached_property
    def places(self) -> Integers:
        """The entries of the vector [N, m] that are free."""
        entries = self.engine.layout.places[list(self.new)][:, self.engine.layout.shared :]
        free = self.engine.layout.free[entries] > 0
        return np.asarray(entries[:, free.all(axis=0)], dtype=np.int64)

    @cached_property
    def _priors(self) -> tuple[Array, Array]:
        """Centers and standard deviations [n_local] of all own entries, in natural units; infinite: not known."""
        parameters = self.engine.parameters
        names = [parameters.model.learnables[i].name for i in parameters.own]
        tables = [np.asarray(self.weights.get(f"per_trajectory.{name}", np.zeros(0))) for name in names]
        tables += list(np.asarray(self.weights["initial"], dtype=np.float64).T)
        center = np.array([table.mean() if len(table) else 0.0 for table in tables])
        sd = np.array([float(spread_of_next(table)) if len(table) > 1 else 0.0 for table in tables])
        return center, np.where(sd > 0, sd, np.inf)

    def _natural(self, vector: Array) -> tuple[Array, Array]:
        """The own entries [N, n_local] in natural units, and their derivatives by the trained ones."""
        parameters = self.engine.parameters
        begin, own = parameters.n_shared, len(parameters.own)
        local = vector[begin : parameters.size].reshape(parameters.trajectories, -1)[list(self.new)]
        scale = np.broadcast_to(STRETCH * np.asarray(parameters.start_scale), (len(local), local.shape[1] - own))
        maps = parameters.bijections(parameters.own)
        values = parameters.start_value[list(self.new)] + scale * local[:, own:]
        slopes = np.array([maps.derivative(row) for row in local[:, :own]]).reshape(len(local), own)
        natural = maps.to_natural(torch.from_numpy(local[:, :own].copy())).numpy()
        return np.concatenate([natural, values], 1), np.concatenate([slopes, scale], 1)

    def penalty(self, vector: Array) -> tuple[float, Array, Array]:
        """The priors' part of the objective, its gradient and matrix diagonal [size]."""
        parameters, (center, sd) = self.engine.parameters, self._priors
        natural, slopes = self._natural(vector)
        z = (natural - center) / sd
        gradient, diagonal = np.zeros(len(vector)), np.zeros(len(vector))
        begin = parameters.n_shared + np.asarray(self.new)[:, None] * parameters.n_local
        entries = begin + np.arange(parameters.n_local)
        gradient[entries], diagonal[entries] = z * slopes / sd, (slopes / sd) ** 2
        free = np.isin(entries, self.places)
        return 0.5 * float(np.sum(z[free] ** 2)), gradient, diagonal + WEAK

    def filtered(self, vector: Array) -> tuple[float, Filtered]:
        """The objective at a vector, and the filter there."""
        found = self.engine.filtered(vector, seen=self.seen)
        return (found.value + self.penalty(vector)[0] if found.finite else np.inf), found

    def system(self, vector: Array, found: Filtered) -> tuple[Array, Array, Array]:
        """The gradient [N, m], the matrices [N, m, m] and those with the shared entries [N, m, shared]."""
        information, (_, gradient, diagonal) = self.engine.information(vector, found), self.penalty(vector)
        places = self.places
        block = information.matrix[places[:, :, None], places[:, None, :]]
        block = block + np.eye(places.shape[1]) * diagonal[places][:, :, None]
        across = information.matrix[places[:, :, None], np.arange(self.engine.parameters.n_shared)]
        return information.gradient[places] + gradient[places], block, across


def estimated_own(
    engine: FilterEngine, vector: Array, seen: Mask, new: Sequence[int], weights: Weights
) -> tuple[Array, Own | None]:
    """The vector with what the trajectories `new` have of their own as the rows `seen` [R, C] and the training say, and
    their uncertainty; `weights` are the run's. The vector as it is where the model has nothing of the kind, or the
    filter is not finite there."""
    fit = _Fit(engine, seen, new, weights)
    if not len(new) or not fit.places.size:
        return vector, None
    value, found = fit.filtered(vector)
    damping = 1e-2
    for _ in range(STEPS if np.isfinite(value) else 0):
        gradient, block, _ = fit.system(vector, found)
        diagonal = np.einsum("nii->ni", block)
        gain, promised = 0.0, 0.0
        for _ in range(ATTEMPTS):
            damped = block + np.eye(block.shape[1]) * (damping * diagonal)[:, :, None]
            move = np.clip(-np.linalg.solve(damped, gradient[..., None])[..., 0], -LONGEST, LONGEST)
            promised = -float(np.sum(gradient * move) + 0.5 * np.einsum("ni,nij,nj->", move, block, move))
            trial = vector.copy()
            trial[fit.places] += move
            tried, after = fit.filtered(trial)
            gain = value - tried
            if gain > 0 or abs(promised) < SMALL:
                break
            damping *= 4.0
        if gain > 0:
            vector, value, found, damping = trial, tried, after, max(damping * 0.2, 1e-9)
        if abs(promised) < SMALL or not gain > 0:
            break
    if not found.finite:
        return vector, None
    _, block, across = fit.system(vector, found)
    sizes, axes = np.linalg.eigh(block)
    roots = axes / np.sqrt(np.maximum(sizes, WEAK))[:, None, :]
    return vector, Own(fit.places, roots, np.asarray(-np.linalg.solve(block, across), dtype=np.float64))
