"""Adaptive Gauss-Hermite quadrature: the densities at its nodes, solved side by side, and their derivatives.

With nodes x and weights w in each dimension, H = C C^T and z(x) = z* + sqrt(2) C^-T x,

    -2 log L = log det H + q log pi - 2 log sum_x w(x) exp(|x|^2 - g(z(x))/2)

(Liu and Pierce 1994; Pinheiro and Bates 1995). With the shares p(x) of the nodes in the sum, its derivative is that of
log det H plus the sum of p(x) times those of g(z(x)): each needs one pass of the solution forward and one back.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.population.likelihood import FARTHEST, Likelihood, bounded
from gbspec.training.population.predictions import Individuals
from gbspec.training.problem import Integers


class Quadrature:
    """`nodes` in each of the dimensions of a unit: J nodes x [J, q]."""

    def __init__(self, likelihood: Likelihood, nodes: int) -> None:
        self.likelihood, self.size = likelihood, likelihood.groups.size
        x, masses = np.polynomial.hermite.hermgauss(nodes)
        grid = list(product(range(nodes), repeat=self.size))
        self.points = torch.tensor([[x[i] for i in at] for at in grid], dtype=torch.float64)
        self.points = self.points.reshape(len(grid), self.size)
        self.log_mass = torch.tensor([sum(np.log(masses[i]) + x[i] ** 2 for i in at) for at in grid]).double()

    def at(self, modes: Tensor, hessian: Tensor) -> Tensor:
        """The nodes z [J, units, q] around the modes [units, q]."""
        # Where H is not finite, the logarithm of its determinant is not a number either, and the point is rejected.
        found, info = torch.linalg.cholesky_ex(hessian)
        factor = torch.where((info == 0)[:, None, None], found, torch.eye(self.size, dtype=hessian.dtype))
        points = self.points.T.expand(len(modes), -1, -1)
        moved: Tensor = torch.linalg.solve_triangular(factor.transpose(1, 2), points, upper=True)
        return modes + 2**0.5 * moved.permute(2, 0, 1)

    def _together(self, nodes: Tensor) -> Iterator[tuple[Likelihood, slice]]:
        """The nodes that are solved together, and the likelihood of so many copies of the trajectories."""
        begin = 0
        for count in self.likelihood.shares(len(nodes)):
            yield self.likelihood.copies(count), slice(begin, begin + count)
            begin += count

    def joint(self, natural: Tensor, nodes: Tensor, weights: Array) -> Tensor:
        """g [J, units] at nodes z [J, units, q], with natural parameters [N, P]."""
        parts = []
        for likelihood, some in self._together(nodes):
            z = nodes[some].reshape(-1, self.size)
            rows = natural.repeat(len(nodes[some]), 1)
            found = likelihood.joint(likelihood.plain(rows, z, weights), z)
            parts.append(found.reshape(-1, self.likelihood.count))
        return torch.cat(parts)

    def total(self, joint: Tensor) -> Tensor:
        """Minus twice the logarithm of the integral [units] without log det H, from g at the nodes [J, units]."""
        # (2 pi)^(-q/2) of z and 2^(q/2) of the change of variables leave pi^(-q/2).
        return -2 * self._log_sum(joint) + self.size * float(np.log(np.pi))

    def _log_sum(self, joint: Tensor) -> Tensor:
        return torch.logsumexp(self.log_mass[:, None] - 0.5 * joint, 0)

    def slopes(self, natural: Tensor, nodes: Tensor, weights: Tensor, safe: Array) -> tuple[Tensor, Tensor, Tensor]:
        """The derivatives of the sum of `total` over the units by natural parameters [N, P], nodes [J, units, q] and
        weights [W]. A trajectory whose solution is not bounded at a node, whose share is as good as 0, is solved with
        the constants `safe` [N, K] in its place."""
        with torch.no_grad():
            joint = self.joint(natural, nodes, weights.numpy())
            share = torch.exp(self.log_mass[:, None] - 0.5 * joint - self._log_sum(joint))
        of_natural, of_weights, of_nodes = torch.zeros_like(natural), torch.zeros_like(weights), []
        for likelihood, some in self._together(nodes):
            count = len(nodes[some])
            z = nodes[some].reshape(-1, self.size).clone().requires_grad_()
            rows, w = natural.repeat(count, 1).requires_grad_(), weights.clone().requires_grad_()
            constants, slope = likelihood.individual(rows, z)
            given = likelihood.predictions.individuals, np.tile(safe, (count, 1)), likelihood.predictions.measured.owner
            mean: Tensor = _Means.apply(constants, w, *given)  # type: ignore[no-untyped-call]  # torch's
            plain = mean[:, None].expand(-1, likelihood.layout.effects)
            found = likelihood.joint(likelihood.compared(mean, plain, slope, rows), z)
            parts = torch.autograd.grad((found * share[some].reshape(-1)).sum(), [rows, z, w], allow_unused=True)
            by = [torch.zeros_like(x) if part is None else part for part, x in zip(parts, (rows, z, w), strict=True)]
            of_natural += by[0].reshape(count, *natural.shape).sum(0)
            of_nodes.append(by[1].reshape(count, *nodes.shape[1:]))
            of_weights += by[2]
        return of_natural, torch.cat(of_nodes), of_weights


class _Means(torch.autograd.Function):
    """Predictions [m] as a function of constants [N, K] and weights [W], differentiable once."""

    @staticmethod
    def forward(
        ctx: Any, constants: Tensor, weights: Tensor, individuals: Individuals, safe: Array, owner: Integers
    ) -> Tensor:
        """The predictions, bounded."""
        at, w = constants.detach().numpy(), weights.detach().numpy()
        mean = bounded(torch.from_numpy(individuals.mean(at, w)))
        bad = np.zeros(len(at), dtype=np.bool_)
        bad[owner[(mean.abs() >= FARTHEST).numpy()]] = True
        ctx.given = individuals, np.where(bad[:, None], safe, at), w, bad[owner]
        return mean

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
        """The products with the Jacobian, zero where a solution is not bounded."""
        individuals, at, weights, lost = ctx.given
        of_constants, of_weights = individuals.back(at, weights, np.where(lost, 0.0, cotangent.numpy()))
        return torch.from_numpy(np.ascontiguousarray(of_constants)), torch.from_numpy(of_weights), None, None, None
