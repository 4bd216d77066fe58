"""How predictions keep the limits of censored measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction import Prediction

if TYPE_CHECKING:
    from gbspec.data import Trajectories
    from gbspec.ir import Model


@dataclass(frozen=True)
class LimitsKept:
    """Of the `n` censored values of a channel, how many predictions lie on the same side of the limit (`kept`), and the
    largest distance of the others from it, in the channel's unit."""

    n: int
    kept: int
    worst: float

    def to_json(self) -> dict[str, object]:
        """Keys n, kept, worst."""
        return {"n": self.n, "kept": self.kept, "worst": self.worst}

    def __str__(self) -> str:
        others = "others" if self.n - self.kept > 1 else "other"
        beyond = f"; the {others} by {self.worst:.4g} at most" if self.kept < self.n else ""
        own = "value is predicted on its" if self.n == 1 else "values are predicted on their"
        return f"{self.kept} of {self.n} censored {own} side of the limit{beyond}"


def limits_kept(model: Model, data: Trajectories, predicted: Sequence[Prediction]) -> dict[str, LimitsKept]:
    """The limits of each channel that has any, in trajectories that can be solved."""
    found: dict[str, LimitsKept] = {}
    solved = [(item.censored, one) for item, one in zip(data.items, predicted, strict=True) if not one.failure]
    for j, channel in enumerate(model.channels):
        parts = [(limits.side[:, j] * (one.channels[:, j] - limits.value[:, j])) for limits, one in solved]
        margin = np.concatenate([np.zeros(0), *parts])  # positive on the right side; NaN without a limit
        margin = margin[np.isfinite(margin)]
        if len(margin):
            found[channel.name] = LimitsKept(len(margin), int((margin >= 0).sum()), float(max(-margin.min(), 0.0)))
    return found
