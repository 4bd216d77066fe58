"""The first rows of a new trajectory, from which what is unknown of it is estimated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gbspec.data import Trajectory
    from gbspec.ir import Model

SHARE, LEAST = 3, 3
"""The default window: one third (1/`SHARE`) of the measured rows, but at least `LEAST`."""


def default_window(item: Trajectory) -> int:
    """The number of measured rows of the window where none is given; there may be fewer."""
    return max(LEAST, int(np.isfinite(item.values).any(axis=1).sum()) // SHARE)


def window_rows(item: Trajectory, model: Model, fixed: bool, window: int | None) -> int:
    """The number of rows up to the end of the window. If nothing is estimated (`fixed`) that is the first row, or none
    where the model gives the starts of all states."""
    if fixed and all(state.initial.known for state in model.states):
        return 0
    measured = np.flatnonzero(np.isfinite(item.values).any(axis=1))
    if not len(measured):
        return 0
    wanted = window if window is not None else default_window(item)
    if fixed:
        wanted = 1
    return int(measured[min(wanted, len(measured)) - 1]) + 1
