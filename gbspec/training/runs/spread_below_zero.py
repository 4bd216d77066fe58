"""Disturbances whose spread reaches below zero where a channel has log-normal noise: values there have no logarithm."""

from __future__ import annotations

import numpy as np

from gbspec.frames import counted
from gbspec.training.engines import Filtered, FilterEngine, filter

REACH = float(np.sqrt(3.0))
"""A spread reaches so many standard deviations from its mean; so far are points over which the filter averages."""


def said_of_spreads(engine: FilterEngine, found: Filtered) -> list[str]:
    """A sentence for each channel that measures a state with log-normal noise, if the state's spread one row ahead of
    the measurements reaches zero. (States that stay positive have a spread of logarithms.)"""
    if not found.finite:
        return []
    out, model, row = [], engine.problem.model, engine.legs.row
    ends = np.flatnonzero(row >= 0)
    ahead = filter.one_row_ahead(engine, found)[1][row[ends]]
    mean, variance = found.end_mean[ends], np.diagonal(found.end_cov[ends], axis1=1, axis2=2)
    for i, channel in enumerate(model.channels):
        state = channel.state
        if state is None or not engine.noise.log[i] or engine.coordinates.bent[state]:
            continue
        m, sd = mean[ahead[:, i], state], np.sqrt(np.maximum(variance[ahead[:, i], state], 0.0))
        below = m - REACH * sd <= 0
        if below.any():
            name = model.states[state].name
            worst = int(np.argmin(m / np.maximum(sd, 1e-300)))
            out.append(
                f"in {int(below.sum())} of {counted(len(m), 'row')} the disturbances let `{name}` reach zero from one "
                f"row to the next (at worst a mean of {m[worst]:.3g} with a standard deviation of {sd[worst]:.3g}), "
                f"where log-normal noise of `{channel.name}` has no value: likelihood and predictions are not right "
                f"there. With a disturbance in proportion to it, `diffusion {name} = s*{name}` with an `s` of its "
                "relative size, the state stays positive"
            )
    return out
