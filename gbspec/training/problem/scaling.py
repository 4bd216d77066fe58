"""The scales of residuals.

`scale` is

- for a channel without a stated noise: the standard deviation of its data over all trajectories;
- for a channel with `noise normal(sd)`, `noise lognormal(cv)` or a column of standard deviations: the stated
  standard deviation, divided by the channels' common noise level (the mean of stated noise / standard deviation of the
  data), so that all residuals are in units of the data's standard deviation and the stated noises determine the
  channels' relative weights.

In a model whose functions are all known, channels that have the same unit and no stated noise share one scale: the fit
is then the ordinary least squares of textbooks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import Trajectories, deviations
from gbspec.ir import Model, logarithmic
from gbspec.training.problem.packing import Packed


@dataclass(frozen=True)
class Scaling:
    """The form of residuals: `log` [C] (of logarithms), `row_scale` [R, C], `channel` [C] (the channel's scale).

    `noise` is the standard deviation of the noise in units of the residuals; None if a channel does not state its
    noise.
    """

    log: Mask
    row_scale: Array
    channel: Array
    noise: float | None = None


def scaling_of(model: Model, packed: Packed, trajectories: Trajectories) -> Scaling:
    """Scales of the residuals (see the module's documentation)."""
    log, deviation = logarithmic(model), deviations(model, trajectories)
    stated = np.full(len(model.channels), np.nan)
    for i, channel in enumerate(model.channels):
        if channel.noise is not None:
            scale = channel.noise.scale
            stated[i] = np.sqrt(np.log1p(scale**2)) if log[i] else scale
        elif np.any(np.isfinite(packed.sd[:, i])):
            stated[i] = float(np.nanmedian(packed.sd[:, i]))
    known = np.isfinite(stated) & (stated > 0)
    level = float(np.mean(stated[known] / deviation[known])) if known.any() else 1.0
    channel_scale = np.where(known, np.where(known, stated, 1.0) / level, deviation)
    if model.complete:
        free = np.flatnonzero(~known).tolist()
        for i in free:
            alike = [j for j in free if model.channels[j].unit == model.channels[i].unit]
            channel_scale[i] = float(np.sqrt(np.mean(deviation[alike] ** 2)))
    row_scale = np.broadcast_to(channel_scale, packed.values.shape).copy()
    own = np.isfinite(packed.sd) & (packed.sd > 0)
    if own.any():
        row_scale = np.where(own, np.where(own, packed.sd, 1.0) / level, row_scale)
    return Scaling(log, row_scale, channel_scale, level if known.all() and level > 0 else None)
