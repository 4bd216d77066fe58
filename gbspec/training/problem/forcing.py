"""Forcing: the replacement of states by given values at key rows during a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.ir import Model
from gbspec.training.problem.packing import Packed


@dataclass(frozen=True)
class Forcing:
    """The values and strengths with which states are replaced at key rows.

    `value` [R, n_states] and `weight` [R, n_states] in [0, 1]: after the row's residual is computed,
    `x <- x - weight * (x - value)`. Teacher forcing has weight 1 at measured states, a blend a smaller one,
    autoregressive 0; imputed teacher forcing has weight 1 at every state, with values from splines.
    """

    value: Array
    weight: Array

    def reset(self, before: Array) -> Array:
        """The states at the key rows [R, n_states] after the replacement."""
        with np.errstate(invalid="ignore", over="ignore"):  # of a solution that is not finite
            blended = before - self.weight * (before - self.value)
        return np.where(self.weight == 1.0, self.value, blended)


def measured_states(model: Model, packed: Packed) -> tuple[Array, Mask]:
    """Measured values of states [R, n_states] (NaN: not measured) and the mask of measured ones.

    If two channels measure the same state, the later one in the model's order is used.
    """
    values = np.full((packed.rows, len(model.states)), np.nan)
    for index, channel in enumerate(model.channels):
        if channel.state is not None:
            column = packed.values[:, index]
            seen = np.isfinite(column)
            values[seen, channel.state] = column[seen]
    return values, np.isfinite(values)


def teacher_forcing(model: Model, packed: Packed, blend: float = 1.0) -> Forcing:
    """Forcing of measured states with strength `blend`."""
    values, seen = measured_states(model, packed)
    return Forcing(np.where(seen, values, 0.0), blend * seen.astype(np.float64))
