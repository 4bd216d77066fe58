"""What is said of intervals that go below zero although the model declares that the quantity does not.

The ends stay as they are computed: a measurement with additive noise may be negative, and an end that was moved to zero
would hide that the noise, or the linearisation, does not suit values near zero. Log-normal noise has no such ends, but
neither has it an interval around a prediction of zero or less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import sympy

from gbspec.arrays import Array
from gbspec.frames import counted
from gbspec.ir import logarithmic
from gbspec.passes import never_negative

if TYPE_CHECKING:
    from gbspec.ir import Channel, Model

FAR = 0.1
"""Nothing is said unless an end is further below zero than this fraction of the largest prediction of the quantity:
warnings of values beyond a declared range begin at the same fraction of its width."""
NEGATIVE = 1e-3
"""Predictions further below zero than this fraction of the largest one are no errors of solving."""


class Predicted(Protocol):
    """What is read of a predicted trajectory: its means and the ends of its intervals [R, V]."""

    @property
    def failure(self) -> str:
        """Why it could not be predicted; empty if it was."""

    @property
    def mean(self) -> Array:
        """The means."""

    @property
    def low(self) -> Array:
        """The lower ends."""

    @property
    def high(self) -> Array:
        """The upper ends."""


def said_of_ends(model: Model, items: Sequence[Predicted], hidden: Sequence[int]) -> list[str]:
    """A warning for each channel, and each of the `hidden` states behind the channels, whose intervals reach far below
    zero although by declared ranges they do not, or whose noise is log-normal around predictions of zero or less."""
    values = [*(channel.value for channel in model.channels), *(model.states[i].symbol for i in hidden)]
    names = [*(channel.name for channel in model.channels), *(model.states[i].name for i in hidden)]
    states = [*(channel.state for channel in model.channels), *hidden]
    log = np.pad(logarithmic(model), (0, len(hidden)))
    solved, found = [item for item in items if not item.failure], []
    for j, (name, value) in enumerate(zip(names, values, strict=True)):
        low, mean, high = (
            np.concatenate([np.zeros(0), *(getattr(item, which)[:, j] for item in solved)])
            for which in ("low", "mean", "high")
        )
        least = float(np.min(low, initial=0.0, where=np.isfinite(low)))
        largest = float(np.max(np.abs(mean), initial=0.0, where=np.isfinite(mean)))
        if log[j]:
            found += said_of_not_positive(model, j, mean[~np.isfinite(low)], len(mean), "their rows have no interval")
        elif least < -FAR * largest and never_negative(model, value):
            rows = f"{int((low < 0).sum())} of {counted(len(low), 'row')} (to {least:.3g})"
            channel = model.channels[j] if j < len(model.channels) else None
            found.append(
                f"the 90 % intervals of `{name}` go below zero in {rows}, although {_declared(model, channel)}: "
                + _why(mean[low < 0], largest, channel)
                + _above(model, states[j], high)
            )
    return found


def said_of_not_positive(model: Model, channel: int, mean: Array, of: int, effect: str) -> list[str]:
    """A warning if some of the predictions `mean` of a channel with log-normal noise, `of` so many, are zero or less,
    with the `effect` of that."""
    below = mean[mean <= 0]
    if not len(below):
        return []
    one = model.channels[channel]
    kept = ", since nothing keeps a start or a solution within a declared range"
    return [
        f"{len(below)} of {counted(of, 'prediction')} of `{one.name}` {'is' if len(below) == 1 else 'are'} zero or "
        f"less (to {below.min():.3g}){kept if never_negative(model, one.value) else ''}. Values with log-normal noise "
        f"cannot be so, and what is not positive has no logarithm: {effect}"
    ]


def _declared(model: Model, channel: Channel | None) -> str:
    """Why values below zero are not those of the model; the channel is None for a state."""
    state = None if channel is None or channel.state is None else model.states[channel.state].name
    if channel is None or state == channel.name:
        return "by its declared range it does not"
    if state is not None:
        return f"by the declared range of `{state}`, which it measures, it does not"
    return "by the declared ranges of what it is computed from it cannot"


def _above(model: Model, state: int | None, high: Array) -> str:
    """What is said of upper ends beyond the declared range of the state that they are of, if any."""
    bounds = None if state is None else model.states[state].range
    most = float(np.max(high, initial=-np.inf, where=np.isfinite(high)))
    if bounds is None or not bounds.bounded or not most > bounds.high + FAR * (bounds.high - bounds.low):
        return ""
    rows = f"{int((high > bounds.high).sum())} of {counted(len(high), 'row')} (to {most:.3g})"
    return f". Upper ends lie beyond the declared range, [{bounds.low:g}, {bounds.high:g}], in {rows}"


def _instead(channel: Channel) -> str:
    """What to write instead; nothing is known for logarithms, whose noise is that of a ratio already."""
    if channel.value.has(sympy.log):
        return ""
    return (
        f". Where it is the noise, and measured values are positive, `observe {channel.name} … noise lognormal(0.1)` "
        "(their relative error; or `lognormal(s)` with `learn s = 0.2 > 0`) has intervals above zero"
    )


def _why(mean: Array, largest: float, channel: Channel | None) -> str:
    """Why intervals around `mean`, those of the rows in which they end below zero, do so; `largest` is the size of the
    largest prediction of all rows, the channel None for a state."""
    negative = mean[mean < -NEGATIVE * largest]
    around = "linearised, by as much to either side"
    if channel is not None:
        around = (
            "those of new measurements, with the noise and what is not known of the model, around the model's value by "
            "as much to either side"
        )
    if not len(negative):
        return f"they are {around}" + (
            ". Values near zero are possible, negative ones are not" if channel is None else _instead(channel)
        )
    which = "" if len(negative) == len(mean) else f" in {len(negative)} of them"
    rest = "" if len(negative) == len(mean) else f". In the others the intervals are {around}"
    return (
        f"the predictions themselves are negative{which} (to {negative.min():.3g}), since nothing keeps a start or a "
        f"solution within a declared range{rest}"
    )
