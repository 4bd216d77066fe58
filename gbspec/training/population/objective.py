"""What is minimised: minus twice the log marginal likelihood, the priors of constants, and the networks' ridge.

    F(w, u) = -2 log L(w, u) + sum over priors ((k - m)/s)^2 + ridge |w|^2

Everything is on the scale of -2 log densities: the ridge is the inverse variance of a normal prior of the weights
around zero, and its strength maximises the evidence of F, Laplace's approximation in (w, u) (MacKay 1992): with the
information J of the weights, of which the constants are profiled out,

    gamma = trace(J (J + ridge I)^-1),      ridge = gamma/|w|^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.ir import Prior
from gbspec.training.optimise import standardised
from gbspec.training.population.layout import Layout
from gbspec.training.population.marginal import Marginal


@dataclass(frozen=True)
class Point:
    """A point (w, u): the objective there, minus twice the log likelihood, and the modes z [N, q]."""

    weights: Array
    u: Array
    objective: float
    minus2ll: float
    z: Array


class Objective:
    """F for one marginal likelihood."""

    def __init__(self, marginal: Marginal) -> None:
        self.marginal = marginal
        self._laplace: Objective | None = None
        self.layout: Layout = marginal.layout
        self.priors: list[tuple[int, Prior]] = [
            (place, one.prior) for place, one in enumerate(self.layout.each) if one.prior is not None
        ]

    def by_laplace(self) -> Objective:
        """The same by Laplace's method; itself, if it is that."""
        if self.marginal.nodes == 1:
            return self
        if self._laplace is None:
            self._laplace = Objective(Marginal(self.layout, self.marginal.predictions))
        return self._laplace

    def at(self, weights: Array, u: Array, z: Array, ridge: float, afresh: bool = False) -> Point:
        """The objective at a point; infinite where the model cannot be solved. `afresh`: as for `Marginal.value`."""
        found = self.marginal.value(u, weights, z, afresh)
        total = found.total if np.isfinite(found.total) else float("inf")
        penalty = float((self._standardised(torch.from_numpy(u)) ** 2).sum()) + ridge * float(weights @ weights)
        return Point(weights, u, total + penalty, total, found.z)

    def _standardised(self, u: Tensor) -> Tensor:
        natural = self.layout.natural(u)
        rows = [standardised(prior, natural[place]) for place, prior in self.priors]
        return torch.stack(rows) if rows else u.new_zeros(0)

    def gradient(self, point: Point, ridge: float) -> Array:
        """The exact gradient by (w, u)."""
        slopes = self.marginal.slopes(point.u, point.weights, point.z)
        at = torch.from_numpy(point.u).clone().requires_grad_()
        rows = self._standardised(at)
        of_priors = torch.autograd.grad((rows**2).sum(), at)[0].numpy() if len(rows) else np.zeros_like(point.u)
        of_weights = slopes.weights + 2 * ridge * point.weights
        return np.concatenate([of_weights, slopes.parameters.sum(axis=0) + of_priors])

    def curvature(self, point: Point, ridge: float) -> Array:
        """Twice the expected information with the curvature of priors and ridge: the expected Hessian of F."""
        found = 2 * self.marginal.information(point.u, point.weights, point.z)
        count = len(point.weights)
        found[:count, :count] += 2 * ridge * np.eye(count)
        if self.priors:
            at = torch.from_numpy(point.u)
            rows = torch.autograd.functional.jacobian(self._standardised, at).numpy()  # type: ignore[no-untyped-call]  # torch does not annotate it
            found[count:, count:] += 2 * rows.T @ rows
        return found

    def evident_ridge(self, point: Point, ridge: float) -> float:
        """The ridge of greatest evidence, given the present one."""
        count = len(point.weights)
        information = self.curvature(point, 0.0) / 2
        within, across = information[:count, :count], information[:count, count:]
        rest = information[count:, count:] + 1e-10 * np.eye(information.shape[0] - count)
        values = np.maximum(np.linalg.eigvalsh(within - across @ np.linalg.solve(rest, across.T)), 0.0)
        gamma = float(np.sum(values / (values + ridge)))
        return max(gamma, 1e-3) / max(float(point.weights @ point.weights), 1e-12)
