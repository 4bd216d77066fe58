"""Adam's update (Kingma and Ba 2015), as a function of arrays, so that its state can be saved and restored.

torch's own optimiser is not used: importing it takes longer than many fits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array

BETAS, EPSILON, CLIP = (0.9, 0.999), 1e-8, 1.0


@dataclass(frozen=True)
class AdamMoments:
    """Running means of gradients and of their squares, and the number of updates."""

    first: Array
    second: Array
    updates: int = 0

    @staticmethod
    def zero(size: int) -> AdamMoments:
        """The moments before the first update."""
        return AdamMoments(np.zeros(size), np.zeros(size))

    def advance(self, gradient: Array, rate: float) -> tuple[AdamMoments, Array]:
        """The moments after a gradient (clipped to norm 1), and the step at a learning rate."""
        gradient = gradient * min(1.0, CLIP / max(float(np.linalg.norm(gradient)), 1e-300))
        n = self.updates + 1
        first = BETAS[0] * self.first + (1 - BETAS[0]) * gradient
        second = BETAS[1] * self.second + (1 - BETAS[1]) * gradient**2
        unbiased = np.sqrt(second / (1 - BETAS[1] ** n)) + EPSILON
        return AdamMoments(first, second, n), -rate / (1 - BETAS[0] ** n) * first / unbiased


def one_cycle(update: int, total: int, peak: float, rise: float = 0.1) -> float:
    """The learning rate of an update: a linear rise over the first part, then a cosine down to a hundredth."""
    top = max(rise * total, 1.0)
    if update <= top:
        return peak * update / top
    return peak * (0.01 + 0.99 * 0.5 * (1 + float(np.cos(np.pi * (update - top) / max(total - top, 1.0)))))
