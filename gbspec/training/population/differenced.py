"""Predictions and sensitivities of models whose steps end where right-hand sides switch, with further derivatives.

Sensitivities jump where solutions switch, and move with the time of that. The engine's Jacobian knows this exactly; its
own derivatives by the constants are central differences of it, of trajectories side by side. Mixed second derivatives
are symmetric, so that two Jacobians for each distributed constant are enough for those by all constants and weights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.problem import Integers

STEP = 1e-5
"""The step of the differences, as a part of a constant: their error is its square, and the error of the steps'
division, 1e-12, over it."""
ASTRAY = 0.1
"""Differences to the two sides that are further from each other than this part of their sizes have met a place where
a sensitivity itself jumps, since a switch passes the time of a measurement: the smaller one has not."""

Jacobian: TypeAlias = Callable[[Array, Array], tuple[Array, Array, Array]]
"""Predictions [m], and their derivatives by constants [m, K] and weights [m, W], at constants [N, K] and weights."""


class Differenced:
    """By differences of `jacobian`; the result is expanded to first order in constants and weights.

    `places` [q] are those of the distributed constants among all, `owner` [m] the trajectory of each value, and `sizes`
    [K] those of constants that are near zero.
    """

    def __init__(self, jacobian: Jacobian, places: Integers, owner: Integers, sizes: Array) -> None:
        self.jacobian, self.places, self.owner, self.sizes = jacobian, places, owner, sizes

    def __call__(self, constants: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Predictions [m] and sensitivities [m, q]."""
        at, w = constants.detach().numpy(), weights.detach().numpy()
        mean, *first = self.jacobian(at, w)
        slopes = np.concatenate(first, 1)
        second = np.stack([self._along(int(place), at, w, slopes) for place in self.places], 1)
        moved = torch.cat([(constants - constants.detach())[torch.from_numpy(self.owner)],
                           (weights - weights.detach()).expand(len(mean), -1)], 1)  # fmt: skip
        value, sensitivity = torch.from_numpy(mean), torch.from_numpy(slopes[:, self.places])
        return (
            value + (torch.from_numpy(slopes) * moved).sum(1),
            sensitivity + torch.einsum("mqk,mk->mq", torch.from_numpy(second), moved),
        )

    def _along(self, place: int, constants: Array, weights: Array, here: Array) -> Array:
        """The derivatives [m, K + W] of the Jacobian by one constant of the own trajectory."""
        step = STEP * np.maximum(np.abs(constants[:, place]), self.sizes[place])
        sides = []
        for sign in (1.0, -1.0):
            moved = constants.copy()
            moved[:, place] += sign * step
            there = np.concatenate(self.jacobian(moved, weights)[1:], 1)
            sides.append(sign * (there - here) / step[self.owner, None])
        up, down = sides
        astray = np.abs(up - down) > ASTRAY * (np.abs(up) + np.abs(down))
        # Of one value all derivatives meet such a place together; those near zero differ by rounding alone.
        size = np.maximum(np.abs(up), np.abs(down))
        lost = (astray & (size > ASTRAY * size.max(axis=1, keepdims=True, initial=0.0))).any(axis=1, keepdims=True)
        smaller = np.where((np.abs(up).sum(1) <= np.abs(down).sum(1))[:, None], up, down)
        return np.asarray(np.where(lost, smaller, 0.5 * (up + down)), dtype=np.float64)
