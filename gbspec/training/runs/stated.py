"""Channels whose values whole solutions follow to the noise that the model or the table states.

R² says little of a signal that is hardly larger than its noise: the best fit of a constant one is below 0, and below
that of a straight line, whose two numbers follow the noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from scipy.special import chdtrc

from gbspec.ir import Model
from gbspec.runs import ChannelRecord, autocorrelated
from gbspec.training.runs.verdict import UNLIKELY, beside_stated

FALL = 9.21
"""A naive predictor of two numbers has a sum of squares, in units of the stated variance, that is smaller by more than
this in one of a hundred tables of noise."""


def to_stated_noise(
    model: Model,
    channels: Mapping[str, ChannelRecord],
    noise: Mapping[str, float],
    tabled: Mapping[str, float],
    freedom: float | None,
) -> dict[str, ChannelRecord]:
    """The records of those channels, with `as_stated`.

    Their residuals are no larger than the stated noise by more than chance (a chi-squared test with the channel's part
    of `freedom`, None: all values), are not correlated with the next ones, and the best naive predictor leaves no
    clearly smaller ones.
    """
    counted, following = sum(one.values or 0 for one in channels.values()), autocorrelated(channels)
    found = {}
    for channel in model.channels if counted and not (model.marginal or model.diffusions) else ():
        record = channels[channel.name]
        times, _ = next(iter(beside_stated(channel, noise, tabled)), (math.nan, ""))
        values = record.values or 0
        left = values if freedom is None else freedom * values / counted
        if record.r2 is None or record.r2 >= 1 or not times > 0 or not left > 0 or channel.name in following:
            continue
        squares = left * times**2
        fall = 0.0 if record.naive is None else squares * (1 - (1 - record.naive) / (1 - record.r2))
        if chdtrc(left, squares) >= UNLIKELY and fall <= FALL:
            found[channel.name] = replace(record, as_stated=True)
    return found
