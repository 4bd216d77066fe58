"""Where the population's parameters stand in the trainable vector, and the constants of single trajectories.

The deviations of a trajectory's constants are `s_k (L z)_k` with standard normal numbers z [q], the spreads s and the
Cholesky factor L of their correlations. L is made from canonical partial correlations (Lewandowski, Kurowicka and Joe
2009), one for each pair of a group: any values between -1 and 1 give a correlation matrix, and with two constants the
one value is their correlation.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Learnable, Level, Model
from gbspec.training.problem import Bijections, Parameters


@dataclass(frozen=True)
class Layout:
    """The parameters u [P] of a population, that is, the shared constants and what distributions and noises imply."""

    parameters: Parameters

    @property
    def model(self) -> Model:
        """The model."""
        return self.parameters.model

    @cached_property
    def each(self) -> tuple[Learnable, ...]:
        """The learnables whose trainable values are u, in order."""
        return (*(self.model.learnables[i] for i in self.parameters.shared), *self.model.implied)

    @cached_property
    def names(self) -> dict[str, int]:
        """The place in u of each of them."""
        return {learnable.name: i for i, learnable in enumerate(self.each)}

    @cached_property
    def typical(self) -> dict[str, int]:
        """The place in u of each constant that all trajectories share, and of the learned median of each distributed
        one, by the constant's name."""
        each = ((k.name, k.name if k.distribution is None else k.distribution.median) for k in self.model.learnables)
        return {name: self.names[parameter] for name, parameter in each if parameter in self.names}

    @cached_property
    def bijections(self) -> Bijections:
        """Their bounds."""
        return Bijections.of(self.each)

    @cached_property
    def distributed(self) -> tuple[Learnable, ...]:
        """The constants with a distribution, in the order of z."""
        return self.model.distributed

    @cached_property
    def place(self) -> list[int]:
        """The place of each of them among the learnables."""
        names = [k.name for k in self.model.learnables]
        return [names.index(k.name) for k in self.distributed]

    @property
    def effects(self) -> int:
        """The number q of distributed constants."""
        return len(self.distributed)

    @cached_property
    def levels(self) -> tuple[tuple[int, Level], ...]:
        """The deviations that groups of trajectories share, each with the place of its constant in `distributed`."""
        each = enumerate(k.distribution for k in self.distributed)
        return tuple((k, level) for k, made in each if made is not None for level in made.levels)

    @property
    def width(self) -> int:
        """The number of standard numbers z of a trajectory: q of its own, then one for each of `levels`."""
        return self.effects + len(self.levels)

    def slice(self) -> slice:
        """Where the trainable vector has u."""
        return slice(self.parameters.n_weights, self.parameters.n_shared)

    def natural(self, u: Tensor) -> Tensor:
        """Natural values [..., P]."""
        return self.bijections.to_natural(u)

    def spreads(self, natural: Tensor) -> Tensor:
        """The spreads [..., q]."""
        found = []
        for learnable in self.distributed:
            made = learnable.distribution
            assert made is not None
            given = natural.new_full(natural.shape[:-1], made.fixed)
            found.append(given if made.spread is None else natural[..., self.names[made.spread]])
        return torch.stack(found, -1) if found else natural.new_zeros((*natural.shape[:-1], 0))

    def correlation_factor(self, natural: Tensor) -> Tensor:
        """The Cholesky factor L [..., q, q] of the correlations of deviations."""
        q, shape = self.effects, natural.shape[:-1]
        rows = [[natural.new_full(shape, float(i == j)) for j in range(q)] for i in range(q)]
        index = {k.name: i for i, k in enumerate(self.distributed)}
        first = len(self.each) - len(self.model.implied) + self._before_correlations
        for group in self.model.correlated:
            partial = {}
            for pair in combinations(group, 2):
                partial[pair] = natural[..., first]
                first += 1
            for b in range(1, len(group)):
                left = natural.new_ones(shape)
                for a in range(b):
                    value = partial[group[a], group[b]] * torch.sqrt(left)
                    rows[index[group[b]]][index[group[a]]] = value
                    left = left - value**2
                rows[index[group[b]]][index[group[b]]] = torch.sqrt(torch.clamp(left, min=1e-12))
        return torch.stack([torch.stack(row, -1) for row in rows], -2) if q else natural.new_zeros((*shape, 0, 0))

    @cached_property
    def _before_correlations(self) -> int:
        """How many implied parameters precede the correlations."""
        declared = {k.name for k in self.model.learnables}
        found = [k.distribution for k in self.distributed if k.distribution is not None]
        each = [spread for m in found for spread in (m.spread, *(level.spread for level in m.levels))]
        spreads = {spread for spread in each if spread is not None and spread not in declared}
        return sum(bool(made.median) for made in found) + len(spreads)

    @cached_property
    def correlations(self) -> range:
        """The places of the correlations in u."""
        pairs = sum(len(group) * (len(group) - 1) // 2 for group in self.model.correlated)
        first = len(self.each) - len(self.model.implied) + self._before_correlations
        return range(first, first + pairs)

    def factor(self, natural: Tensor) -> Tensor:
        """The factor B [..., q, width] of the covariance B B^T of deviations."""
        own = self.spreads(natural)[..., None] * self.correlation_factor(natural)
        if not self.levels:
            return own
        columns = []
        for k, level in self.levels:
            given = natural.new_full(natural.shape[:-1], level.fixed)
            spread = given if level.spread is None else natural[..., self.names[level.spread]]
            unit = torch.zeros(self.effects, dtype=natural.dtype)
            unit[k] = 1.0
            columns.append(spread[..., None] * unit)
        return torch.cat([own, torch.stack(columns, -1)], -1)

    def individual(self, natural: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
        """Distributed constants [..., q] of trajectories with these deviations [..., q], and their derivatives."""
        values, slopes = [], []
        for k, learnable in enumerate(self.distributed):
            made, eta = learnable.distribution, deviation[..., k]
            assert made is not None
            median = natural[..., self.names[made.median]] if made.median else torch.zeros_like(eta)
            match made.kind:
                case "lognormal":
                    value = median * torch.exp(eta)
                    slope = value
                case "logitnormal":
                    low, width = learnable.range.low, learnable.range.high - learnable.range.low
                    share = torch.sigmoid(torch.logit((median - low) / width) + eta)
                    value, slope = low + width * share, width * share * (1 - share)
                case _:
                    value, slope = median + eta, torch.ones_like(eta)
            values.append(value)
            slopes.append(slope)
        if not values:
            return deviation, deviation
        return torch.stack(values, -1), torch.stack(slopes, -1)

    def constants(self, natural: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """All learnables [N, K] of trajectories with natural parameters [N, P] and standard numbers z [N, width], and
        the derivatives [N, q, width] of the distributed ones by z."""
        factor = self.factor(natural)
        own, slope = self.individual(natural, torch.einsum("nij,nj->ni", factor, z))
        columns = []
        for i, learnable in enumerate(self.model.learnables):
            if i in self.place:
                columns.append(own[:, self.place.index(i)])
            else:
                columns.append(natural[:, self.names[learnable.name]])
        table = torch.stack(columns, 1) if columns else natural.new_zeros((len(natural), 0))
        return table, slope[..., None] * factor

    def numbers(self, natural: Tensor, individual: Tensor) -> Tensor:
        """The standard numbers z [N, width] of trajectories whose distributed constants are `individual` [N, q]; those
        of levels are 0, if the constant also differs between trajectories."""
        deviations = []
        for k, learnable in enumerate(self.distributed):
            made, value = learnable.distribution, individual[:, k]
            assert made is not None
            median = natural[:, self.names[made.median]] if made.median else torch.zeros_like(value)
            match made.kind:
                case "lognormal":
                    eta = torch.log(value / median)
                case "logitnormal":
                    low, width = learnable.range.low, learnable.range.high - learnable.range.low
                    eta = torch.logit((value - low) / width) - torch.logit((median - low) / width)
                case _:
                    eta = value - median
            deviations.append(eta)
        if not deviations:
            return individual
        deviation, spreads = torch.stack(deviations, -1), self.spreads(natural)
        scaled = torch.where(spreads > 0, deviation / torch.clamp(spreads, min=1e-12), torch.zeros_like(deviation))
        found = torch.linalg.solve_triangular(self.correlation_factor(natural), scaled[..., None], upper=False)[..., 0]
        factor = self.factor(natural)
        parts = [found]
        for e, (k, _) in enumerate(self.levels):
            alone = (spreads[:, k] <= 0) & (factor[:, k, self.effects + e] > 0)
            own = deviation[:, k] / torch.clamp(factor[:, k, self.effects + e], min=1e-12)
            parts.append(torch.where(alone, own, torch.zeros_like(own))[:, None])
        found = torch.cat(parts, 1)
        return torch.where(torch.isfinite(found), torch.clamp(found, -8.0, 8.0), torch.zeros_like(found))

    def covariance_of_deviations(self, natural: Array) -> Array:
        """The covariance of the deviations [q, q]."""
        with torch.no_grad():
            factor = self.factor(torch.from_numpy(natural)).numpy()
        return np.asarray(factor @ factor.T, dtype=np.float64)
