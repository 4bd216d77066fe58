"""What a fit of a model with delays says of the past that the data do not hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.stats import f as variance_ratio

from gbspec.arrays import Array
from gbspec.ir import Model
from gbspec.runs import ChannelRecord
from gbspec.training.engines import lags, residual_table
from gbspec.training.problem import Parameters
from gbspec.training.recipe import Context, step_fraction
from gbspec.training.runs.verdict import not_followed

CLEARLY = 2.0
"""Residuals within the first delay are this many times as large as later ones, and"""
CHANCE = 1e-3
"""larger than chance makes them with more than this probability (ratio of two variances)."""
FEWEST = 3
"""So many residuals within and after the first delay are compared."""


def said_of_past(
    context: Context,
    parameters: Parameters,
    theta: Array,
    stages: Sequence[str],
    channels: Mapping[str, ChannelRecord],
) -> list[str]:
    """A sentence for each channel of which whole solutions are far from the data within the first delay.

    Without `history` a state was before the start what it is there; data recorded from the middle of a course say
    otherwise, for as long as that past is seen. Nothing is said of `channels` that solutions do not follow anywhere.
    """
    taken = _taken_as_constant(context.model)
    if not taken:
        return []
    engine = context.engine(parameters, 0.0, step_fraction(stages))
    problem, residuals = engine.problem, residual_table(engine, theta)
    packed, begins = problem.packed, np.array([item.start for item in context.trajectories.items])
    with torch.no_grad():
        longest = lags(problem, parameters.constants(torch.from_numpy(theta))).numpy().max(axis=1)
    within = packed.row_time - begins[packed.row_trajectory] <= longest[packed.row_trajectory]
    out = []
    for i, channel in enumerate(context.model.channels):
        if not_followed(channels.get(channel.name)):
            continue
        seen = problem.valued[:, i]
        ratio = _ratio(residuals[seen & within, i], residuals[seen & ~within, i])
        if ratio is not None:
            states = " and ".join(f"`{name}`" for name in taken)
            histories = " and ".join(f"`history {name} = …`" for name in taken)
            out.append(
                f"the residuals of `{channel.name}` within the first delay ({longest.max():.3g}) are {ratio:.2g} times "
                f"as large as later ones: the model takes {states} to be constant before the start, which these data "
                f"contradict; they move constants and functions. Write what the past was, {histories} (learned "
                "constants and the time may stand in it), or leave the cells of the first delay empty"
            )
    return out


def _ratio(early: Array, late: Array) -> float | None:
    """How many times as large the early residuals are, if clearly more so than by chance."""
    if min(len(early), len(late)) < FEWEST or not np.isfinite([*early, *late]).all() or not late.any():
        return None
    ratio = float(np.mean(early**2) / np.mean(late**2))
    clear = ratio > CLEARLY**2 and variance_ratio.sf(ratio, len(early), len(late)) < CHANCE
    return ratio**0.5 if clear else None


def _taken_as_constant(model: Model) -> list[str]:
    """The delayed states that have no history."""
    delayed = {delay.source for delay in model.delays}
    return [state.name for state in model.states if state.name in delayed and state.history is None]
