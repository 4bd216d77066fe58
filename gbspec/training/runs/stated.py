"""Channels whose values whole solutions follow to the noise that the model or the table states.

R² says little of a signal that is hardly larger than its noise: the best fit of a constant one is below 0, and below
that of a straight line, whose two numbers follow the noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from scipy.special import chdtrc

from gbspec.ir import Model
from gbspec.runs import ChannelRecord, autocorrelated
from gbspec.training.runs.verdict import UNLIKELY, far_smaller

FALL = 9.21
"""A naive predictor of two numbers has a sum of squares, in units of the variance of the noise, that is smaller by more
than this in one of a hundred tables of noise."""


def to_stated_noise(
    model: Model, channels: Mapping[str, ChannelRecord], beside: Mapping[str, float], freedom: float | None
) -> dict[str, ChannelRecord]:
    """The records of those channels, with `as_stated`.

    `beside` is how many times as large as the stated noise residuals are, of channels with a stated noise for every
    value. They are no larger by more than chance (a chi-squared test with the channel's part of `freedom`, None: all
    values), nor so much smaller that the stated noise is too large to test anything; they are not correlated with the
    next ones, and replicates show nothing that the model lacks. The best naive predictor leaves no clearly smaller
    ones, in units of the stated variance or of that of the residuals, whichever is smaller.
    """
    counted, following = sum(one.values or 0 for one in channels.values()), autocorrelated(channels)
    found = {}
    for name, times in beside.items() if counted and not (model.marginal or model.diffusions) else ():
        record = channels[name]
        values = record.values or 0
        left = values if freedom is None else freedom * values / counted
        if record.r2 is None or record.r2 >= 1 or not times > 0 or not left > 0 or name in following:
            continue
        if far_smaller(times, left) or (record.lack_of_fit is not None and record.lack_of_fit < UNLIKELY):
            continue
        squares = left * times**2
        fall = 0.0 if record.naive is None else max(left, squares) * (1 - (1 - record.naive) / (1 - record.r2))
        if chdtrc(left, squares) >= UNLIKELY and fall <= FALL:
            found[name] = replace(record, as_stated=True)
    return found
