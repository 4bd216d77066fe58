"""The sampling of a model without a case: times, conditions, inputs and doses as in the data of a run.

Without it the truth would be followed for ten units of time whatever the model's unit is: of an hour in seconds that is
the beginning only, in which hardly anything changes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from gbspec.data import Box, SimulateOptions, Trajectories

if TYPE_CHECKING:
    from gbspec.arrays import Array
    from gbspec.ir import Condition, Input, Model


def sampling_like(model: Model, data: Trajectories | None) -> SimulateOptions:
    """The default sampling with the longest trajectory of the data as its span, and as many rows in it as by default.

    Conditions and inputs without a declared range have that of the data, and doses are drawn like those of the data.
    """
    options = SimulateOptions()
    span = max((item.end - item.start for item in data.items), default=0.0) if data is not None else 0.0
    if data is None or not span > 0.0:
        return options
    condition: dict[str, Box] = {}
    external: tuple[Condition | Input, ...] = (*model.conditions, *model.inputs)
    for i, item in enumerate(external):
        if item.range is None or not item.range.bounded:
            columns = [_external(one.condition, [signal.values for signal in one.inputs], i) for one in data.items]
            box = _box(columns)
            if box is not None:
                condition[item.name] = box
    return replace(
        options, span=span, dt=options.dt * (span / options.span), condition=condition, dose=_doses(model, data)
    )


def starting(model: Model, data: Trajectories | None) -> Model:
    """The model with its time starting at the first row of the data, if it says nothing about its start."""
    if data is None or not data.items or model.time.start is not None:
        return model
    return replace(model, time=replace(model.time, start=min(item.start for item in data.items)))


def _external(condition: Array, inputs: list[Array], i: int) -> Array:
    """The values of a trajectory's condition or, counted after these, input."""
    return condition[i : i + 1] if i < len(condition) else inputs[i - len(condition)]


def _box(columns: list[Array]) -> Box | None:
    values = np.concatenate(columns)
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if len(values) else None


def _doses(model: Model, data: Trajectories) -> dict[str, str]:
    """For each dosed state, the times of the trajectory with the most doses and the range of all amounts."""
    found = {}
    for j, dose in enumerate(model.doses):
        given = [item.doses[j] for item in data.items]
        box = _box([one.amounts for one in given])
        if box is not None:
            times = max((one.times for one in given), key=len)
            found[dose.state] = f"{box[0]!r}:{box[1]!r}@{','.join(repr(float(time)) for time in times)}"
    return found


__all__ = ["sampling_like", "starting"]
