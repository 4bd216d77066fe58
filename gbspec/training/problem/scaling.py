"""The scales of residuals (`gbspec.data.scales_of`) at the rows of a packing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import Estimated, Trajectories, scales_of
from gbspec.ir import Model
from gbspec.training.problem.packing import Packed


@dataclass(frozen=True)
class Scaling:
    """The form of residuals: `log` [C] (of logarithms), `row_scale` [R, C], `channel` [C] (the channel's scale).

    `share` [C] is the share of each channel's values that count (None: all do): the scale is larger for it, so that
    residuals divided by its square root have the standard deviation of the noise.
    `noise` is the standard deviation of the noise in units of the residuals; None if a channel does not state its
    noise. `levels` [C]: the same of each channel, 0 where it is not known (None: nowhere).
    """

    log: Mask
    row_scale: Array
    channel: Array
    noise: float | None = None
    share: Array | None = None
    levels: Array | None = None


def scaling_of(model: Model, packed: Packed, trajectories: Trajectories, estimated: Estimated | None = None) -> Scaling:
    """The scales for all trajectories of a fit, at the rows of a packing of these or of others."""
    scales = scales_of(model, trajectories, estimated)
    share = None if estimated is None or (estimated.share == 1).all() else estimated.share
    values = np.where(packed.limits.side == 0, packed.values, packed.limits.value)
    rows = scales.of_rows(packed.sd, values, packed.weights**2)
    return Scaling(scales.log, rows, scales.channel, scales.noise, share, scales.levels)
