"""Where predictions leave what a run was trained with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.solutions import Start, extrapolated
from gbspec.analysis.systems import Extrapolation, extrapolation_of, trained_ranges
from gbspec.arrays import Array

if TYPE_CHECKING:
    from gbspec.data import Trajectory
    from gbspec.ir import Model
    from gbspec.runs import Run


@dataclass(frozen=True)
class Trained:
    """Where a run was trained: the `ranges` of states and conditions, and how far the data lie, if that is known."""

    ranges: Mapping[str, tuple[float, float]]
    extrapolation: Extrapolation | None

    @staticmethod
    def of(run: Run) -> Trained:
        """What the run's first member was trained with."""
        return Trained(trained_ranges(run.model, run.members[0]), extrapolation_of(run))

    def outside(self, model: Model, item: Trajectory, states: Array, start: Start) -> tuple[tuple[str, ...], ...]:
        """For each row the functions that are extrapolated, and the states and conditions outside their trained ranges.

        Where it is known how far the data lie, a range (left by more than a hundredth of its width) counts only in rows
        in which a function is extrapolated.
        """
        values: dict[str, Array] = {
            **{state.name: states[:, i] for i, state in enumerate(model.states)},
            **{c.name: np.full(len(states), item.condition[i]) for i, c in enumerate(model.conditions)},
        }
        beyond = {}
        for name, (low, high) in self.ranges.items():
            if name in values:
                slack = 0.01 * (high - low)
                beyond[name] = (values[name] < low - slack) | (values[name] > high + slack)
        if self.extrapolation is not None:
            far = extrapolated(self.extrapolation, model, item, states, start)
            anywhere = np.any([*far.values(), np.zeros(len(states), dtype=bool)], axis=0)
            beyond = {name: flags & anywhere for name, flags in beyond.items()} | far
        return tuple(tuple(name for name, flags in beyond.items() if flags[row]) for row in range(len(states)))
