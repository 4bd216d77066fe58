"""What is said of predicted states far outside of their declared ranges, as `train` and `validate` say it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gbspec.analysis.prediction.below_zero import Predicted
from gbspec.data import said_of_ranges, states_beyond

if TYPE_CHECKING:
    from gbspec.ir import Model


def said_of_states(model: Model, items: Sequence[Predicted], hidden: Sequence[int]) -> list[str]:
    """A warning of the states that predictions take far outside of their ranges: of those that a channel measures
    directly, and of the `hidden` ones behind the channels."""
    columns = {channel.state: j for j, channel in enumerate(model.channels) if channel.state is not None}
    columns |= {state: len(model.channels) + j for j, state in enumerate(hidden)}
    solved = [item.mean for item in items if not item.failure]
    if not solved:
        return []
    means = np.concatenate(solved)
    states = np.full((len(means), len(model.states)), np.nan)
    for state, column in columns.items():
        states[:, state] = means[:, column]
    return [f"{said}. {_REMEDY}" for said in said_of_ranges(states_beyond(model, states))]


_REMEDY = "Where a start was estimated, more rows (a longer `--window`) may determine it"
