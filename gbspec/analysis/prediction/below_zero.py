"""What is said of intervals that go below zero although the model declares that the quantity does not.

The ends stay as they are computed: a measurement with additive noise may be negative, and an end that was moved to zero
would hide that the noise, or the linearisation, does not suit values near zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

import numpy as np
import sympy
from sympy import Expr

from gbspec.arrays import Array
from gbspec.frames import counted
from gbspec.passes import never_negative

if TYPE_CHECKING:
    from gbspec.ir import Channel, Model

FAR = 0.1
"""Nothing is said unless an end is further below zero than this fraction of the largest prediction of the quantity:
warnings of values beyond a declared range begin at the same fraction of its width."""


class Predicted(Protocol):
    """What is read of a predicted trajectory: its means and the lower ends of its intervals [R, V]."""

    @property
    def failure(self) -> str:
        """Why it could not be predicted; empty if it was."""

    @property
    def mean(self) -> Array:
        """The means."""

    @property
    def low(self) -> Array:
        """The lower ends."""


def said_of_ends(model: Model, items: Sequence[Predicted], hidden: Sequence[int]) -> list[str]:
    """A warning for each channel, and each of the `hidden` states behind the channels, whose intervals reach far below
    zero although by declared ranges they do not."""
    values = [*(channel.value for channel in model.channels), *(model.states[i].symbol for i in hidden)]
    names = [*(channel.name for channel in model.channels), *(model.states[i].name for i in hidden)]
    solved, found = [item for item in items if not item.failure], []
    for j, (name, value) in enumerate(zip(names, values, strict=True)):
        low, mean = (
            np.concatenate([np.zeros(0), *(getattr(item, which)[:, j] for item in solved)]) for which in ("low", "mean")
        )
        least = float(np.min(low, initial=0.0, where=np.isfinite(low)))
        largest = float(np.max(np.abs(mean), initial=0.0, where=np.isfinite(mean)))
        if least < -FAR * largest and never_negative(model, value):
            rows = f"{int((low < 0).sum())} of {counted(len(low), 'row')} (to {least:.3g})"
            channel = model.channels[j] if j < len(model.channels) else None
            found.append(
                f"the 90 % intervals of `{name}` go below zero in {rows}, although {_declared(model, channel)}: "
                + (_hidden(name, mean) if channel is None else _MEASURED + _instead(name, value))
            )
    return found


def _declared(model: Model, channel: Channel | None) -> str:
    """Why values below zero are not those of the model; the channel is None for a state."""
    state = None if channel is None or channel.state is None else model.states[channel.state].name
    if channel is None or state == channel.name:
        return "by its declared range it does not"
    if state is not None:
        return f"by the declared range of `{state}`, which it measures, it does not"
    return "by the declared ranges of what it is computed from it cannot"


def _instead(name: str, value: Expr) -> str:
    """What to write instead; nothing is known for logarithms, whose noise is that of a ratio already."""
    if value.has(sympy.log):
        return ""
    return (
        f". Where it is the noise, and measured values are positive, `observe {name} … noise lognormal(0.1)` (their "
        "relative error; or `lognormal(s)` with `learn s = 0.2 > 0`) has intervals above zero"
    )


_MEASURED = (
    "they are those of new measurements, with the noise and what is not known of the model, around the model's value "
    "by as much to either side"
)


def _hidden(name: str, mean: Array) -> str:
    """What ends below zero of a state say whose predictions are `mean`."""
    least = float(np.min(mean, initial=0.0, where=np.isfinite(mean)))
    if least < -FAR * float(np.max(np.abs(mean), initial=0.0, where=np.isfinite(mean))):
        return (
            f"its predictions are negative themselves (to {least:.3g}), since nothing keeps a start or a solution "
            "within a declared range"
        )
    return "they are linearised, by as much to either side. Values near zero are possible, negative ones are not"
