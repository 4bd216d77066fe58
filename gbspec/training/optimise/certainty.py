"""What the curvature at the end of a fit says of its constants."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbspec.arrays import Array
from gbspec.training.problem import Parameters


@dataclass(frozen=True)
class Certainty:
    """Standard deviations [k] and correlations [k, k] of the shared constants (natural values), and the degrees of
    freedom that the fit used, with priors and ridge taken into account; NaN, and no correlations, if not known.

    `own` [N, j] are the standard deviations of the constants per trajectory. `loosened` [k], where constants ended at
    bounds: how many times as large the deviations of those tied to them would be with these free (1 for others, NaN for
    these); else empty.
    """

    deviations: Array = field(default_factory=lambda: np.zeros(0))
    correlations: Array = field(default_factory=lambda: np.zeros((0, 0)))
    freedom: float = float("nan")
    own: Array = field(default_factory=lambda: np.zeros((0, 0)))
    loosened: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        """Raises ValueError if the arrays do not fit each other, as those of a damaged file."""
        count = self.deviations.shape
        if len(count) != 1 or self.own.ndim != 2 or self.correlations.shape not in ((0, 0), count * 2):
            raise ValueError("the standard deviations, or their correlations, have another shape")

    @classmethod
    def unknown(cls, parameters: Parameters) -> Certainty:
        """The result if nothing is known."""
        count, own = len(parameters.shared), (parameters.trajectories, len(parameters.own))
        return cls(np.full(count, np.nan), np.full((count, count), np.nan), own=np.full(own, np.nan))
