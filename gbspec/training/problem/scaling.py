"""The scales of residuals (`gbspec.data.scales_of`) at the rows of a packing."""

from __future__ import annotations

from dataclasses import dataclass

from gbspec.arrays import Array, Mask
from gbspec.data import Trajectories, scales_of
from gbspec.ir import Model
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
    """The scales for all trajectories of a fit, at the rows of a packing of these or of others."""
    scales = scales_of(model, trajectories)
    return Scaling(scales.log, scales.of_rows(packed.sd, packed.values), scales.channel, scales.noise)
