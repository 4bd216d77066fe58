"""How often events happen in the solutions at a vector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gbspec.arrays import Array
from gbspec.training.engines.engine import Engine
from gbspec.training.engines.native import NativeEngine


@dataclass(frozen=True)
class Happened:
    """`counts` [N, events]: how often each event happens in each trajectory; `endless` [N]: whether events follow each
    other without end in it, so that it has no solution from there on; `uncut` [N]: its sub-steps that go across a
    switch of right-hand sides where others are cut."""

    counts: NDArray[np.int32]
    endless: NDArray[np.bool_]
    uncut: NDArray[np.int32]


def happened(engine: Engine, theta: Array) -> Happened | None:
    """The events at a vector; None for a model without events, and for engines that do not count them (torch)."""
    if not engine.problem.model.events or not isinstance(engine, NativeEngine):
        return None
    swept = engine.happened(theta, engine.plan(theta))
    return Happened(swept.happened, swept.endless > 0, swept.uncut)
