"""Channels whose solutions are straight lines in time, whatever the constants: exponential laws under log-normal noise.

A straight line through the data of each trajectory knows no model, but there it is the model: no solution can follow
the data better, and one that follows them as well is no worse for it.
"""

from __future__ import annotations

import sympy
from sympy.core.function import AppliedUndef

from gbspec.ir import Channel, Model, counted_channels, logarithmic


def straight(model: Model) -> set[str]:
    """The names of the channels whose solutions (their logarithms, if the noise is log-normal) are straight lines in
    time in each trajectory, by the model's balances. Of counts the scale of their noise lies between roots and
    logarithms: constant ones are straight on it, and exponential ones nearly."""
    if model.events or model.delays or model.doses or model.diffusions or model.algebraics or model.processes:
        return set()
    each = zip(model.channels, logarithmic(model), counted_channels(model), strict=True)
    return {channel.name for channel, log, counted in each if _straight(model, channel, log or counted)}


def _straight(model: Model, channel: Channel, log: bool) -> bool:
    """Whether the derivative of a channel by time, or of its logarithm, contains nothing that changes."""
    (value,) = model.inlined([channel.value])
    inputs = {one.symbol for one in model.inputs}
    rates = dict(zip((one.symbol for one in model.states), model.inlined(model.balances), strict=True))
    if value.free_symbols & inputs or value.atoms(AppliedUndef):
        return False
    slope = value.diff(model.time.symbol)
    for symbol in sorted(value.free_symbols & rates.keys(), key=str):
        slope += value.diff(symbol) * rates[symbol]
    if slope.atoms(AppliedUndef):
        return False
    slope = sympy.expand_mul(slope / value if log else slope)
    return not slope.free_symbols & {*inputs, *rates, model.time.symbol}
