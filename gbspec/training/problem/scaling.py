"""The scales of residuals (`gbspec.data.scales_of`) at the rows of a packing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data import Estimated, Trajectories, scales_of
from gbspec.ir import ErrorScale, Model, error_scales
from gbspec.training.problem.packing import Packed


@dataclass(frozen=True)
class Scaling:
    """The form of residuals: `log` [C] (of logarithms), `row_scale` [R, C], `channel` [C] (the channel's scale).

    `share` [C] is the share of each channel's values that count (None: all do): the scale is larger for it, so that
    residuals divided by its square root have the standard deviation of the noise.
    `noise` is the standard deviation of the noise in units of the residuals; None if a channel does not state its
    noise. `levels` [C]: the same of each channel, 0 where it is not known (None: nowhere). `sizes` [C]: of counts whose
    residuals are on the scale of their noise, 0 of other channels (None: none are).
    """

    log: Mask
    row_scale: Array
    channel: Array
    noise: float | None = None
    share: Array | None = None
    levels: Array | None = None
    sizes: Array | None = None


def scaling_of(model: Model, packed: Packed, trajectories: Trajectories, estimated: Estimated | None = None) -> Scaling:
    """The scales for all trajectories of a fit, at the rows of a packing of these or of others.

    Counts are compared on the scale of their noise at the declared size, in units of the deviation of the data there,
    that of all their channels together: least squares are then close to the likelihood, in which a prediction of next
    to none where there were many counts is worse than any other.
    """
    scales = scales_of(model, trajectories, estimated)
    share = None if estimated is None or (estimated.share == 1).all() else estimated.share
    values = np.where(packed.limits.side == 0, packed.values, packed.limits.value)
    rows = scales.of_rows(packed.sd, values, packed.weights**2)
    of = error_scales(model, {k.name: k.start for k in model.learnables})
    sizes = np.array([0.0 if scale.size is None else scale.size for scale in of])
    counts = sizes > 0
    if counts.any():
        each = [_deviation(of[i], trajectories, i) for i in np.flatnonzero(counts).tolist()]
        rows[:, counts] = float(np.sqrt(np.mean(np.square(each)))) or 1.0
    sizes_of_any = sizes if counts.any() else None
    return Scaling(scales.log, rows, scales.channel, scales.noise, share, scales.levels, sizes_of_any)


def _deviation(scale: ErrorScale, trajectories: Trajectories, channel: int) -> float:
    """The standard deviation of a channel's values on its scale; 0 without any."""
    values = np.concatenate([scale.measured(item.values[:, channel]) for item in trajectories.items])
    values = values[np.isfinite(values)]
    return float(np.std(values)) if len(values) else 0.0
