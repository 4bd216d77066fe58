"""States that are declared from zero and have values below it.

Declared ranges are for scales and warnings: nothing keeps a start or a solution within them. What balances say of
negative amounts is seldom meant, and a pole (`S/(S + K)`) or a root of a negative number may lie there.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import Model

SHARE = 0.1
"""Values count as below zero where they are so by more than this fraction of the state's largest size: rounding and
small errors of a fit are less."""
DEVIATIONS = 2.0
"""Of a measured state they count from so many standard deviations of the noise on."""


def below_zero(
    model: Model, states: Array, noise: Mapping[str, float] | None = None, among: Array | None = None
) -> dict[str, float]:
    """The lowest value of each state that is declared from 0 and has values [rows, states] clearly below it; `noise`
    has standard deviations of channels by name. `among`: the values that tell the sizes of states, else the same."""
    allowed = np.zeros(len(model.states))
    for channel in model.channels:
        if channel.state is not None:
            allowed[channel.state] = DEVIATIONS * np.nan_to_num((noise or {}).get(channel.name, 0.0))
    found = {}
    every = states if among is None else among
    for state, column, all_values, least in zip(model.states, states.T, every.T, allowed, strict=True):
        known = column[np.isfinite(column)]
        largest = float(np.abs(all_values[np.isfinite(all_values)]).max(initial=0.0))
        size = max(SHARE * largest, float(least))
        if state.range is not None and state.range.low == 0.0 and float(known.min(initial=0.0)) < -size:
            found[state.name] = float(known.min())
    return found
