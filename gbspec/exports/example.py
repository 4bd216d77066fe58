"""One trajectory that an export can simulate by itself, with the command that gives the same table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gbspec.arrays import Array
from gbspec.data import DoseEvents, Signal
from gbspec.exports.subject import Exported


@dataclass(frozen=True)
class Example:
    """A trajectory from `x0` at `start`: outputs at `times`, conditions, inputs, doses; `command` simulates it."""

    x0: Array
    start: float
    times: Array
    condition: Array
    inputs: tuple[Signal, ...]
    doses: tuple[DoseEvents, ...]
    command: str = ""


def plain(exported: Exported) -> Example:
    """A trajectory from the initial values, with nothing that changes."""
    times = exported.start + np.linspace(0.5, 10.0, 20)
    inputs = tuple(Signal(np.array([exported.start]), np.array([value])) for value in exported.inputs)
    nothing = DoseEvents(np.zeros(0), np.zeros(0))
    doses = (nothing,) * len(exported.model.doses)
    return Example(exported.states, exported.start, times, exported.conditions, inputs, doses)
