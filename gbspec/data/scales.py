"""The scales s and weights w of residuals: fits, refits of initial states and reports take them from here.

`gbspec.ir.residual` has the formula. The weight of an entry is the square root of the number of measurements that it
averages, 0 where nothing was measured. The scale of a channel is

- without a stated noise: the standard deviation of its data over all trajectories;
- with `noise normal(sd)`, `noise lognormal(cv)` or a column of standard deviations (in the unit of the values: that of
  the logarithm, under `lognormal`, is the given one over the size of the value): the stated standard deviation, divided
  by the channels' common noise level (the mean of stated noise / standard deviation of the data), so that all
  residuals are in units of the data's standard deviation and the stated noises determine the channels' relative
  weights. An entry with its own standard deviation has its own scale;
- of counts: as without a stated noise, and in proportion to the root of the count (at least 1), which is about its
  standard deviation, over the root of the mean of all (fits compare counts on the scale of their noise instead, see
  `gbspec.training.problem.scaling`);
- with an estimated noise: as if it were stated. Where successive residuals follow one another, only a share of the
  channel's values counts: its scale is divided by the square root of this share.

In a model whose functions are all known, channels that declare the same unit and no noise share one scale: the fit is
then the ordinary least squares of textbooks. Nothing is known about channels without units (a voltage may stand beside
a temperature), so each has its own scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array, Mask
from gbspec.data.statistics import deviations
from gbspec.data.trajectories import Trajectories, Trajectory
from gbspec.ir import Model, counted_channels, logarithmic


@dataclass(frozen=True)
class Scales:
    """The scales of a model's channels for a table: `log` [C] (residuals of logarithms), `channel` [C] the scales.

    `deviation` [C] is the standard deviation of each channel's data; `level` the common noise level, by which standard
    deviations of single entries are divided; `noise` the standard deviation of the noise in units of the residuals, or
    None if a channel does not state its noise. `levels` [C] is that of each channel, 0 where it is not known.
    """

    log: Mask
    channel: Array
    deviation: Array
    level: float
    noise: float | None
    levels: Array | None = None
    counts: Array | None = None
    """The mean count [C] of channels that are counts, NaN of others (None: none are)."""

    @property
    def value_weights(self) -> Array:
        """The weight [C] of a squared error of each channel, in units of the variance of its data."""
        return np.asarray((self.deviation / self.channel) ** 2, dtype=np.float64)

    def of_rows(self, sd: Array, values: Array, counts: Array) -> Array:
        """The scales [R, C] of single measurements of entries that average `counts` [R, C] of them and have the
        standard deviations `sd` [R, C] (NaN: none of its own), in the unit of their `values`; a value of zero has no
        standard deviation of its logarithm, and the channel's scale."""
        relative = np.divide(sd, np.abs(values), out=np.full_like(sd, np.nan), where=np.abs(values) > 0)
        # That of an average is smaller by the root of their number, which `weights` has already.
        found = np.where(self.log, relative, sd) * np.sqrt(np.maximum(counts, 1.0))
        own = np.isfinite(found) & (found > 0)
        usual = self.channel
        if self.counts is not None:
            root = np.sqrt(np.maximum(np.nan_to_num(values), 1.0) / np.where(self.counts > 0, self.counts, 1.0))
            usual = np.where(self.counts > 0, self.channel * root, self.channel)
        return np.where(own, np.where(own, found, 1.0) / self.level, usual)

    def factor(self, item: Trajectory) -> Array:
        """w / s [R, C] of a trajectory's measurements; 0 where nothing was measured."""
        scales = self.of_rows(item.sd, item.values, item.counts)
        return np.asarray(weights(item.values, item.counts) / scales, dtype=np.float64)


def weights(values: Array, counts: Array) -> Array:
    """The weights [R, C] of entries that average `counts` [R, C] measurements; 0 where nothing was measured."""
    return np.where(np.isfinite(values), np.sqrt(counts), 0.0)


@dataclass(frozen=True)
class Estimated:
    """What residuals say of the channels whose noise is not stated: its standard deviation `noise` [C] (NaN: stated, or
    not known), and the `share` [C] of their values that count, as others repeat them (1: all)."""

    noise: Array
    share: Array


def scales_of(model: Model, trajectories: Trajectories, estimated: Estimated | None = None) -> Scales:
    """The scales of residuals of a table (see the module's documentation), with `estimated` noise where none is
    stated."""
    log, deviation = logarithmic(model), deviations(model, trajectories)
    stated = _stated(model, trajectories)
    believed = np.isfinite(stated) & (stated > 0)
    sd = stated if estimated is None else np.where(believed, stated, estimated.noise)
    known = np.isfinite(sd) & (sd > 0)
    level = float(np.mean(sd[known] / deviation[known])) if known.any() else 1.0
    channel = np.where(known, np.where(known, sd, 1.0) / level, deviation)
    if model.complete:
        units = [_unit(model, i) for i in range(len(known))]
        free = [i for i in np.flatnonzero(~known).tolist() if units[i] is not None]
        for i in free:
            alike = [j for j in free if units[j] == units[i]]
            channel[i] = float(np.sqrt(np.mean(deviation[alike] ** 2)))
    levels = np.where(known, level, 0.0)
    if estimated is not None:
        channel = np.where(believed, channel, channel / np.sqrt(estimated.share))
        levels = np.where(believed, levels, levels * np.sqrt(estimated.share))
    noise = level if believed.all() and level > 0 else None
    return Scales(log, channel, deviation, level, noise, levels, _mean_counts(model, trajectories))


def _mean_counts(model: Model, trajectories: Trajectories) -> Array | None:
    """The mean of the measured counts, each at least 1, of channels [C] that are counts; None without any."""
    counted = counted_channels(model)
    if not counted.any():
        return None
    values = np.concatenate([np.zeros((0, len(counted))), *(item.values for item in trajectories.items)])
    known = np.isfinite(values)
    total = np.where(known, np.maximum(np.nan_to_num(values), 1.0), 0.0).sum(axis=0)
    return np.where(counted, total / np.maximum(known.sum(axis=0), 1), np.nan)


def unstated(model: Model, trajectories: Trajectories) -> Mask:
    """The channels [C] with measurements whose noise neither the model nor the table states."""
    stated = _stated(model, trajectories)
    seen = [np.isfinite(item.values).any(axis=0) for item in trajectories.items]
    measured = np.any([np.zeros(len(model.channels), dtype=bool), *seen], axis=0)
    return np.asarray(measured & ~(np.isfinite(stated) & (stated > 0)), dtype=np.bool_)


def _unit(model: Model, index: int) -> str | None:
    """The declared unit of a channel, or of the state that it measures; None if none is declared."""
    channel = model.channels[index]
    return channel.unit if channel.unit or channel.state is None else model.states[channel.state].unit


def _stated(model: Model, trajectories: Trajectories) -> Array:
    """The standard deviation of each channel's noise [C] (of logarithms, if log-normal); NaN if it is not stated."""
    none = np.zeros((0, len(model.channels)))
    sd = np.concatenate([none, *(item.sd for item in trajectories.items)])
    found = np.full(len(model.channels), np.nan)
    for i, channel in enumerate(model.channels):
        if channel.noise is not None and channel.noise.value is None:
            scale = channel.noise.scale
            found[i] = np.sqrt(np.log1p(scale**2)) if channel.noise.kind == "lognormal" else scale
        elif np.isfinite(sd[:, i]).any():
            found[i] = float(np.nanmedian(sd[:, i]))
    return found
